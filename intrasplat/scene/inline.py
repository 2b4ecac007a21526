"""Join ES modules of the page into one classic script, for a file that opens without a server.

It understands these forms, which our modules use, and refuses all others:

    import { a, b as c } from "./x.js";             export function, export class, export const NAME
    new Worker(new URL("./x.js", import.meta.url), { type: "module" })
"""

from __future__ import annotations

import json
import re
from pathlib import Path

_IMPORT = re.compile(r'^import \{([^}]*)\} from "(\.{1,2}/[^"]+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?function|class|const) (\w+)", re.MULTILINE)
_WORKER = re.compile(r'new Worker\(new URL\("(\./[^"]+)", import\.meta\.url\), \{ type: "module" \}\)')
_COMMENT = re.compile(r"^\s*/\*\*.*?\*/", re.MULTILINE | re.DOTALL)
_OTHER = re.compile(r"^\s*(?:import|export)\b(?!:).*|\bimport(?:\(|\.meta).*", re.MULTILINE)
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
    script = f'"use strict";\n{START_WORKER}{_Bundle().of(entry)}'
    if found := _ENDS_SCRIPT.search(script):
        raise CannotInlineError(f"{entry.name} or a module of its holds {found.group()}, which would end the script")
    return script


class _Bundle:
    """The modules of one script. Each is a function that is called once and returns its exports."""

    def __init__(self) -> None:
        self._names: dict[Path, str] = {}
        self._open: list[Path] = []
        self._text: list[str] = []

    def of(self, entry: Path) -> str:
        self._add(entry.resolve())
        return "".join(self._text)

    def _add(self, path: Path) -> str:
        """Add a module after those that it imports; return the name of the variable with its exports."""
        if path in self._open:
            raise CannotInlineError(f"{path.name} imports itself, by way of others")
        if path not in self._names:
            self._open.append(path)
            text = self._inlined(path)
            self._open.remove(path)
            self._names[path] = f"module{len(self._names)}"
            self._text.append(f"const {self._names[path]} = (() => {{\n{text}}})();\n")
        return self._names[path]

    def _inlined(self, path: Path) -> str:
        source = path.read_text(encoding="utf-8")

        def imported(found: re.Match[str]) -> str:
            names = re.sub(r"\s+as\s+", ": ", found.group(1))
            return f"const {{{names}}} = {self._add((path.parent / found.group(2)).resolve())};"

        def worker(found: re.Match[str]) -> str:
            script = f'"use strict";\n{_Bundle().of(path.parent / found.group(1))}'
            return f"startWorker({json.dumps(script)})"

        exports = [found.group(2) for found in _EXPORT.finditer(source)]
        text = _EXPORT.sub(r"\1 \2", _WORKER.sub(worker, _IMPORT.sub(imported, source)))
        rest = source
        for known in (_COMMENT, _IMPORT, _EXPORT, _WORKER):  # types in comments are imported, too
            rest = known.sub("", rest)
        if other := _OTHER.search(rest):
            raise CannotInlineError(f"{path.name} has a form that is not understood: {other.group().strip()[:80]}")
        return f"{text.rstrip()}\nreturn {{ {', '.join(exports)} }};\n"
