"""The files of the web page. They may stay in browsers' caches for good: their address has a hash of all of them.

Each HTML file, such as `/`, names its scripts and styles below `/v/HASH/`, which their own relative imports keep. The
same files are there without a hash, too, and are cached nowhere.
"""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache
from pathlib import Path

from starlette.middleware.gzip import GZipMiddleware
from starlette.responses import HTMLResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Scope

INDEX = "index.html"
VERSIONED = "v"
"""First part of the paths of versioned files; the second is the hash."""
HASH_DIGITS = 16
FOREVER = "public, max-age=31536000, immutable"
REVALIDATE = "no-cache"
REFERENCE = re.compile(r'((?:href|src)=")(\w[^":#]*")')
"""A file of the page, named relative to an HTML file beside the index; links begin with a dot."""
MIN_COMPRESSED_BYTES = 1000


def page_files(folder: Path) -> ASGIApp:
    """The application that serves the page in a folder, compressed for whoever takes gzip."""
    return GZipMiddleware(_Files(folder), minimum_size=MIN_COMPRESSED_BYTES)


class _Files(StaticFiles):
    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, html=True)
        self._folder = folder

    async def get_response(self, path: str, scope: Scope) -> Response:
        name = INDEX if path == "." else path
        if name in (each.name for each in self._folder.glob("*.html")):
            return _html(self._folder / name, _version(self._folder))
        first, _, rest = path.partition("/")
        if first != VERSIONED:
            return await super().get_response(path, scope)
        version, _, file = rest.partition("/")
        response = await super().get_response(file, scope)
        if version == _version(self._folder):  # another one is of a page that is older or newer than this service
            response.headers["Cache-Control"] = FOREVER
        return response


def _html(file: Path, version: str) -> Response:
    text = file.read_text(encoding="utf-8")
    text = REFERENCE.sub(rf"\g<1>{VERSIONED}/{version}/\g<2>", text)
    return HTMLResponse(text, headers={"Cache-Control": REVALIDATE})


def _version(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return _hash_of(tuple((path, path.stat().st_mtime_ns, path.stat().st_size) for path in files))


@lru_cache(maxsize=2)
def _hash_of(files: tuple[tuple[Path, int, int], ...]) -> str:
    """The hash of the files' contents: the same on every machine that serves the same page."""
    digest = hashlib.sha256()
    for path, _, size in files:
        digest.update(f"{path.name} {size}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:HASH_DIGITS]
