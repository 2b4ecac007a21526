"""What the inliner of the page's modules refuses, and which scripts it writes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from intrasplat.scene.inline import CannotInlineError, inlined, joined


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ('import * as all from "./b.js";', "not understood"),
        ('import "./b.js";', "not understood"),
        ('const b = await import("./b.js");', "not understood"),
        ("export default 1;", "not understood"),
        ("export let a = 1;", "not understood"),
        ("const a = 1;\nexport { a };", "not understood"),
        ('import { a } from "./a.js";\nexport const a = 1;', "imports itself"),
        ("export const a = '</script>';", "would end the script"),
        ("console.log(import.meta.url);", "not understood"),
    ],
)
def test_a_form_that_the_inliner_does_not_know_is_refused(tmp_path: Path, source: str, problem: str) -> None:
    (tmp_path / "b.js").write_text("export const b = 1;\n")
    (tmp_path / "a.js").write_text(source)
    with pytest.raises(CannotInlineError, match=problem):
        inlined(tmp_path / "a.js")


@pytest.mark.parametrize(
    ("sources", "problem"),
    [
        ({"main": "await import('b')", "b": "await import('c')", "c": ""}, "b.js is imported later and imports c.js"),
        ({"main": "await import('b')", "b": "await import('b')"}, "by itself"),
        ({"main": "await import('main')"}, "by itself"),
        (
            {"main": "await import('b'); await import('c')", "b": "import d", "c": "import d", "d": ""},
            "d.js is needed by b.js and c.js",
        ),
        ({"main": "await import('b'); await import('c')", "b": "import c", "c": ""}, "c.js is needed by b.js and c.js"),
        ({"main": "await import('b')", "other": "await import('b')", "b": ""}, "by two scripts"),
    ],
)
def test_late_modules_that_would_be_made_twice_are_refused(
    tmp_path: Path, sources: dict[str, str], problem: str
) -> None:
    for name, source in sources.items():
        lines = re.sub(r"^import (\w)$", r'import { \1 } from "./\1.js";', source)
        lines = re.sub(r"import\('(\w+)'\)", r'import("./\1.js")', lines)
        (tmp_path / f"{name}.js").write_text(f"{lines}\nexport const {name} = 1;\n")
    with pytest.raises(CannotInlineError, match=problem):
        joined(*(tmp_path / f"{name}.js" for name in ("main", "other") if name in sources))


def test_late_modules_share_what_the_page_has_and_a_worker_may_start_itself(tmp_path: Path) -> None:
    worker = 'new Worker(new URL("./w.worker.js", import.meta.url), { type: "module" });\n'
    sources = {
        "main": f'import {{ d }} from "./d.js";\n{worker}await import("./b.js");\nawait import("./c.js");\n',
        "b": 'import { d } from "./d.js";\nexport const b = d;\n',
        "c": 'import { d } from "./d.js";\nexport const c = d;\n',
        "d": "export const d = [];\n",
        "w.worker": f"export const again = () => {worker}",
    }
    for name, source in sources.items():
        (tmp_path / f"{name}.js").write_text(source)
    assert {path.stem for path in joined(tmp_path / "main.js")} == {"main", "b", "c", "w.worker"}
