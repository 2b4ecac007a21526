"""The files of the web page. They may stay in browsers' caches for good: their address has a hash of all of them.

Each HTML file, such as `/`, names its scripts and styles below `/v/HASH/`. There its script is one module with all that
it imports, so that a first visit does not wait for a hundred requests. The same files are there without a hash, too, as
they were written, and are cached nowhere. An HTML file has its words in the browser's language: on a slow line they are
there at the first paint. Scripts that cannot be joined are served as they were written.
"""

from __future__ import annotations

import gzip
import hashlib
import html
import json
import logging
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from threading import Lock

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.middleware.gzip import GZipMiddleware
from starlette.responses import HTMLResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Scope

from intrasplat.scene.inline import CannotInlineError, joined

INDEX = "index.html"
VERSIONED = "v"
"""First part of the paths of versioned files; the second is the hash."""
HASH_DIGITS = 16
FOREVER = "public, max-age=31536000, immutable"
REVALIDATE = "no-cache"
REFERENCE = re.compile(r'((?:href|src)=")(\w[^":#]*")')
"""A file of the page, named relative to an HTML file beside the index; links begin with a dot."""
MIN_COMPRESSED_BYTES = 1000
SCRIPT = re.compile(r'<script type="module" src="([^"]+)"')
PLACE = re.compile(r'(<(?:\w+)[^>]*\bdata-words="(\w+)\.(\w+)"[^>]*>)[^<]*')
MESSAGES = {language: f"base/messages.{language}.js" for language in ("en", "de")}
"""Tables of words; the first is of whoever asks for no other."""
_JOINING = Lock()
"""After a change on disk scripts are joined once, whoever asks for them at the same time."""

logger = logging.getLogger("intrasplat.service")


def page_files(folder: Path) -> ASGIApp:
    """The application that serves the page in a folder, compressed for whoever takes gzip."""
    _current(folder)  # not while others wait
    return GZipMiddleware(_Files(folder), minimum_size=MIN_COMPRESSED_BYTES)


class _Files(StaticFiles):
    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, html=True)
        self._folder = folder

    async def get_response(self, path: str, scope: Scope) -> Response:
        name = INDEX if path == "." else path
        if name in (each.name for each in self._folder.glob("*.html")):
            return await run_in_threadpool(_html, self._folder, name, _language(Headers(scope=scope)))
        first, _, rest = path.partition("/")
        if first != VERSIONED:
            return await super().get_response(path, scope)
        version, _, file = rest.partition("/")
        current, scripts = await run_in_threadpool(_current, self._folder)
        response = await super().get_response(file, scope)
        script = scripts.get(self._folder.resolve() / file)
        if script is not None and response.status_code == 200:
            response = _script(script, is_compressed="gzip" in Headers(scope=scope).get("Accept-Encoding", ""))
        if version == current:  # another one is of a page that is older or newer than this service
            response.headers["Cache-Control"] = FOREVER
        return response


@lru_cache(maxsize=4)
def _text(folder: Path, name: str, version: str, language: str) -> str:
    text = (folder / name).read_text(encoding="utf-8")
    if (folder / MESSAGES[language]).is_file():
        text = text.replace('<html lang="en">', f'<html lang="{language}">', 1)
        text = PLACE.sub(_filled(_words(folder / MESSAGES[language])), text)
    return REFERENCE.sub(rf"\g<1>{VERSIONED}/{version}/\g<2>", text)


def _html(folder: Path, name: str, language: str) -> Response:
    headers = {"Cache-Control": REVALIDATE, "Vary": "Accept-Language"}
    return HTMLResponse(_text(folder, name, _version(folder), language), headers=headers)


def _script(compressed: bytes, *, is_compressed: bool) -> Response:
    headers = {"Vary": "Accept-Encoding"} | ({"Content-Encoding": "gzip"} if is_compressed else {})
    body = compressed if is_compressed else gzip.decompress(compressed)
    return Response(body, media_type="text/javascript", headers=headers)


def _current(folder: Path) -> tuple[str, Mapping[Path, bytes]]:
    """The version of the files as they are now, and their scripts."""
    version = _version(folder)
    with _JOINING:
        return version, _scripts(folder, version)


@lru_cache(maxsize=2)
def _scripts(folder: Path, version: str) -> Mapping[Path, bytes]:
    """The modules of the HTML files' scripts, joined, as gzip; none of them if one cannot be joined."""
    try:
        pages = [page.read_text(encoding="utf-8") for page in sorted(folder.glob("*.html"))]
        scripts = joined(*(folder / entry for page in pages for entry in SCRIPT.findall(page)))
    except (CannotInlineError, OSError, UnicodeError) as error:
        logger.warning("the page's scripts are served as they were written: %s", error)
        return {}
    return {path: gzip.compress(text.encode()) for path, text in scripts.items()}


def _words(table: Path) -> Mapping[str, Mapping[str, str]]:
    text = table.read_text(encoding="utf-8")
    words: dict[str, dict[str, str]] = json.loads(text[text.index("{") : text.rindex("}") + 1])
    return words


def _filled(words: Mapping[str, Mapping[str, str]]) -> Callable[[re.Match[str]], str]:
    return lambda place: place[1] + html.escape(words[place[2]][place[3]], quote=False)


def _language(headers: Headers) -> str:
    """The first of the browser's languages that has words."""
    asked = [each.strip()[:2].lower() for each in headers.get("Accept-Language", "").split(",")]
    return next((each for each in asked if each in MESSAGES), next(iter(MESSAGES)))


def _version(folder: Path) -> str:
    files = []
    for path in sorted(folder.rglob("*")):
        with suppress(OSError):  # it was removed just now
            if path.is_file():
                files.append((path, path.stat().st_mtime_ns, path.stat().st_size))
    return _hash_of(tuple(files))


@lru_cache(maxsize=2)
def _hash_of(files: tuple[tuple[Path, int, int], ...]) -> str:
    """The hash of the files' contents: the same on every machine that serves the same page."""
    digest = hashlib.sha256()
    for path, _, size in files:
        digest.update(f"{path.name} {size}\n".encode())
        with suppress(OSError):  # nobody gets it
            digest.update(path.read_bytes())
    return digest.hexdigest()[:HASH_DIGITS]
