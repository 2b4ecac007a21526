"""Join ES modules of the page: into one classic script for a file that opens without a server, or one module a page.

It understands these forms, which our modules use, and refuses all others:

    import { a, b as c } from "./x.js";             export function, export class, export const NAME
    new Worker(new URL("./x.js", import.meta.url), { type: "module" })

and in pages also

    await import("./x.js")                          new URL("x", import.meta.url)
"""

from __future__ import annotations

import json
import os
import re
from abc import ABC, abstractmethod
from pathlib import Path

_COMMENT = re.compile(r"^[ \t]*(?:/\*\*.*?\*/|//[^\n]*)[ \t]*\n?", re.MULTILINE | re.DOTALL)
_IMPORT = re.compile(r'^import \{([^}]*)\} from "(\.{1,2}/[^"]+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?function|class|const) (\w+)", re.MULTILINE)
_WORKER = re.compile(r'new Worker\(new URL\("(\./[^"]+)", import\.meta\.url\), \{ type: "module" \}\)')
_URL = re.compile(r'new URL\("([^"]+)", import\.meta\.url\)')
_LATER = re.compile(r'\bawait import\("(\.{1,2}/[^"]+)"\)')
_OTHER = re.compile(r"^\s*(?:import|export)\b(?!:).*|(?<!\{)\bimport(?:\(|\.meta).*", re.MULTILINE)
_ENDS_SCRIPT = re.compile(r"</script|<!--", re.IGNORECASE)

START_WORKER = """\
const startWorker = (source) => new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
"""
"""Starts a classic worker: on a page from a disk, Chromium starts no module worker from a blob."""


class CannotInlineError(ValueError):
    """A module contains a form that is not understood; the message names the module and the form."""


def inlined(entry: Path) -> str:
    """One script of a module and all that it imports; safe inside <script>.

    Raises:
        CannotInlineError: a form is not understood, or modules import each other in a circle.
        OSError: a module is missing.
    """
    script = f'"use strict";\n{START_WORKER}{_Inlined(entry).text()}'
    if found := _ENDS_SCRIPT.search(script):
        raise CannotInlineError(f"{entry.name} or a module of its holds {found.group()}, which would end the script")
    return script


def joined(*entries: Path) -> dict[Path, str]:
    """The modules to serve in place of files, by these: each page's script with all that it imports, its workers
    likewise, and what it imports later with what only that needs.

    Raises:
        CannotInlineError: also if a module that is imported later imports others later, or if two scripts would each
            have a module of their own that they should share.
        OSError: a module is missing.
    """
    scripts: dict[Path, str] = {}
    for entry in entries:
        _join(_Joined(entry), scripts)
    return scripts


def _join(bundle: _Joined, scripts: dict[Path, str]) -> None:
    """Add the script of a bundle, of its workers and of what it imports later. Raises as joined()."""
    text = bundle.text()
    if bundle.entry in scripts:
        if scripts[bundle.entry] == text:
            return
        raise CannotInlineError(f"{bundle.entry.name} is imported later by two scripts, or by itself")
    scripts[bundle.entry] = text
    for worker in bundle.workers:
        _join(_Joined(worker), scripts)
    owners: dict[Path, Path] = {}
    for entry in dict.fromkeys(bundle.later):
        part = _Joined(entry, bundle)
        _join(part, scripts)
        if part.later:
            raise CannotInlineError(f"{entry.name} is imported later and imports {part.later[0].name} later")
        for path in part.names.keys() - bundle.names.keys():
            if owners.setdefault(path, entry) != entry:
                raise CannotInlineError(
                    f"{path.name} is needed by {owners[path].name} and {entry.name}, which are imported later, "
                    f"and not by {bundle.entry.name}"
                )


class _Bundle(ABC):
    """The modules of one script. Each is a function that is called once and returns its exports."""

    DECLARES = "const"
    FORMS: tuple[re.Pattern[str], ...] = ()
    """What names another file, besides import statements."""

    def __init__(self, entry: Path) -> None:
        self.entry = entry.resolve()
        self.names: dict[Path, str] = {}
        """The variables with the exports of modules."""
        self._open: list[Path] = []
        self._text: list[str] = []

    def text(self) -> str:
        """The script."""
        self._add(self.entry)
        return "".join(self._text)

    @abstractmethod
    def _bound(self, source: str, folder: Path) -> str:
        """The source of a module in a folder, with FORMS rewritten: the addresses in them fit the script's place."""

    def _add(self, path: Path) -> str:
        """Add a module after those that it imports; return the name of the variable with its exports."""
        if path in self._open:
            raise CannotInlineError(f"{path.name} imports itself, by way of others")
        if path not in self.names:
            self._open.append(path)
            text = self._written(path)
            self._open.remove(path)
            self.names[path] = self._name(path)
            self._text.append(f"{self.DECLARES} {self.names[path]} = (() => {{\n{text}}})();\n")
        return self.names[path]

    def _name(self, path: Path) -> str:
        """A variable for a module's exports, made of the names of its folder and file.

        It does not change when other modules come or go: a page that was opened before an update may import a later
        script of after it, which asks for modules by these names.
        """
        name = re.sub(r"\W", "_", f"module_{path.parent.name}_{path.stem}")
        return name + "_" * sum(each.rstrip("_") == name for each in self.names.values())

    def _written(self, path: Path) -> str:
        source = _COMMENT.sub("", path.read_text(encoding="utf-8"))

        def imported(found: re.Match[str]) -> str:
            names = re.sub(r"\s+as\s+", ": ", found.group(1))
            return f"const {{{names}}} = {self._add((path.parent / found.group(2)).resolve())};"

        rest = source
        for form in (*self.FORMS, _IMPORT, _EXPORT):
            rest = form.sub("", rest)
        if other := _OTHER.search(rest):
            raise CannotInlineError(f"{path.name} has a form that is not understood: {other.group().strip()[:80]}")
        text = _EXPORT.sub(r"\1 \2", self._bound(_IMPORT.sub(imported, source), path.parent))
        return f"{text.rstrip()}\nreturn {{ {', '.join(_exports(source))} }};\n"


class _Inlined(_Bundle):
    """A classic script; workers are texts in it."""

    FORMS = (_WORKER,)

    def _bound(self, source: str, folder: Path) -> str:
        def worker(found: re.Match[str]) -> str:
            script = f'"use strict";\n{_Inlined(folder / found.group(1)).text()}'
            return f"startWorker({json.dumps(script)})"

        return _WORKER.sub(worker, source)


class _Joined(_Bundle):
    """A module that is served in place of its entry.

    whole: the script that imports this one later. This one takes the modules that both need from it.
    """

    DECLARES = "export const"
    FORMS = (_URL, _LATER)

    def __init__(self, entry: Path, whole: _Joined | None = None) -> None:
        super().__init__(entry)
        self._whole = whole
        self.names |= {} if whole is None else whole.names
        self.workers: list[Path] = []
        self.later: list[Path] = []

    def text(self) -> str:
        text, entry = super().text(), self.names[self.entry]
        if names := _exports(self.entry.read_text(encoding="utf-8")):
            text += f"export const {{ {', '.join(names)} }} = {entry};\n"
        if self._whole is None:
            return text
        used = [name for name in self._whole.names.values() if re.search(rf"\b{name}\b", text)]
        return f'import {{ {", ".join(used)} }} from "{self._address(self._whole.entry)}";\n{text}'

    def _address(self, path: Path) -> str:
        return f"./{Path(os.path.relpath(path, self.entry.parent)).as_posix()}"

    def _bound(self, source: str, folder: Path) -> str:
        def later(found: re.Match[str]) -> str:
            path = (folder / found.group(1)).resolve()
            self.later.append(path)
            return f'await import("{self._address(path)}")'

        self.workers += [(folder / name).resolve() for name in _WORKER.findall(source)]
        source = _URL.sub(
            lambda found: f'new URL("{self._address((folder / found.group(1)).resolve())}", import.meta.url)', source
        )
        return _LATER.sub(later, source)


def _exports(source: str) -> list[str]:
    return [found.group(2) for found in _EXPORT.finditer(source)]
