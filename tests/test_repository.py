"""The repository is consistent: links resolve, commands exist, versions agree, no file is too long."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import importlib.util
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from intrasplat.machine.gpu import MAX_TRITON, MIN_TRITON, triton_range

REPOSITORY = Path(__file__).resolve().parent.parent
PAGES = sorted([*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/**/*.md"), *REPOSITORY.glob("docker/**/*.md")])
TARGETS = (
    "help", "setup", "demo", "test", "check", "bench", "gpu-check", "evaluate", "capacity", "chaos", "sbom", "clean",
)  # fmt: skip
MAX_LINES = 400
OURS = ("intrasplat", "contract", "worker", "service", "client", "intrasplat_client", "lab", "tests")
LINK = re.compile(r"\[(?:[^\[\]]|\\.)*\]\(([^)\s]+)\)")


def project(folder: str = ".") -> dict[str, Any]:
    """The table [project]: of the library, or of the server ("service") or the HTTP client ("client")."""
    document = tomllib.loads((REPOSITORY / folder / "pyproject.toml").read_text(encoding="utf-8"))
    table: dict[str, Any] = document["project"]
    return table


def links(page: Path) -> list[tuple[Path, str]]:
    """The files, with the #anchor or "", that a page's links within the repository lead to."""
    targets = [each for each in LINK.findall(page.read_text(encoding="utf-8")) if not re.match(r"[a-z]+:", each)]
    parts = [unquote(each).partition("#") for each in targets]
    return [(page.parent / path if path else page, anchor) for path, _, anchor in parts]


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as code hosts make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", LINK.sub(lambda link: link[0][1 : link[0].index("](")], text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


def requirement_name(requirement: str) -> str:
    return re.split(r"[<>=!~;\[ ]", requirement, maxsplit=1)[0].lower()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_between_pages_and_files_resolve(page: Path) -> None:
    assert [str(path) for path, _ in links(page) if not path.exists()] == []
    to_headings = [(path, anchor) for path, anchor in links(page) if anchor and path.suffix == ".md"]
    assert [f"{path}#{anchor}" for path, anchor in to_headings if anchor not in anchors(path)] == []


def names_in_the_tree() -> list[str]:
    """What the annotated tree in docs/index.md names, as paths."""
    page = (REPOSITORY / "docs" / "index.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```\w*\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    tree = next(each for each in blocks if each.startswith("intrasplat/"))
    named, folder = [], ""
    for line in tree.splitlines():
        # Names end where the description begins: after two spaces, or at the end of the line.
        names = re.split(r"\s{2,}", line.strip())
        candidates = [each for each in names if re.fullmatch(r"[a-z0-9_]+(/|\.py)", each)]
        if not line.startswith(" "):
            folder = candidates[0]
            candidates = [""]
        named += [folder + each for each in candidates]
    return named


def test_the_tree_in_the_docs_names_only_what_exists() -> None:
    assert [each for each in names_in_the_tree() if not (REPOSITORY / each).exists()] == []


@pytest.mark.parametrize("package", ["intrasplat", "contract", "lab"])
def test_the_tree_in_the_docs_names_every_room(package: str) -> None:
    modules = {f"{package}/{path.name}" for path in (REPOSITORY / package).glob("[!_]*.py")}
    folders = {f"{package}/{path.parent.name}/" for path in (REPOSITORY / package).glob("*/__init__.py")}
    assert sorted((modules | folders) - {*names_in_the_tree()}) == []


MAX_README_WORDS = 700


def python_example(page: str) -> ast.Module:
    """The only Python example of a page."""
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    (example,) = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert len(example.splitlines()) <= 20
    return ast.parse(example)


def attributes(example: ast.Module, name: str) -> set[str]:
    """What the example takes from a variable: `scene.render` is `render` of `scene`."""
    return {
        node.attr
        for node in ast.walk(example)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == name
    }


def test_the_readmes_example_uses_only_what_the_library_offers() -> None:
    import intrasplat as isp

    example = python_example("README.md")
    used = attributes(example, "isp")
    assert used == {"read_clip", "reconstruct", "orbit", "load"}
    assert used <= set(isp.__all__)
    called = attributes(example, "scene")
    assert called == {"render", "save", "export"}
    assert [name for name in sorted(called) if not hasattr(isp.Scene, name)] == []
    named_in_its_comment = {"rgb", "depth_mm", "confidence"}
    assert named_in_its_comment <= {field.name for field in dataclasses.fields(isp.View)} | set(dir(isp.View))


def test_the_clients_example_calls_only_what_the_client_offers() -> None:
    called = attributes(python_example("docs/client.md"), "client")
    offered = importlib.import_module("intrasplat_client").Client
    assert called >= {"reconstruct", "wait", "report", "render_array", "stream"}
    assert [name for name in sorted(called) if not hasattr(offered, name)] == []


def test_the_readme_is_short() -> None:
    assert len((REPOSITORY / "README.md").read_text(encoding="utf-8").split()) <= MAX_README_WORDS


def test_the_readme_says_it_is_no_medical_device() -> None:
    readme = " ".join((REPOSITORY / "README.md").read_text(encoding="utf-8").split())
    assert "Research use only" in readme
    assert "not a medical device" in readme


def test_the_console_script_leads_to_a_function() -> None:
    module, _, function = project()["scripts"]["intrasplat"].partition(":")
    assert callable(getattr(importlib.import_module(module), function))


@pytest.mark.parametrize("target", TARGETS)
def test_make_knows_the_target(target: str) -> None:
    listed = subprocess.run(["make", "help"], cwd=REPOSITORY, capture_output=True, text=True, timeout=30, check=True)
    assert re.search(rf"^  make {target}\s+\S", listed.stdout, re.MULTILINE), listed.stdout


def test_versions_agree() -> None:
    version = project()["version"]
    citation = (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    changelog = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    assert [project(folder)["version"] for folder in ("service", "client")] == [version, version]
    assert {f"intrasplat=={version}", f"intrasplat-client=={version}"} <= set(project("service")["dependencies"])
    assert re.findall(r"^version: (\S+)$", citation, re.MULTILINE) == [version]
    assert re.findall(r"^## (\S+)", changelog, re.MULTILINE)[0] == version


def test_every_direct_dependency_has_a_constraint_and_no_other_has() -> None:
    lines = (REPOSITORY / "constraints.txt").read_text(encoding="utf-8").splitlines()
    constrained = {requirement_name(each) for each in lines if each and not each.startswith("#")}
    extras = project()["optional-dependencies"]
    needed = [*project()["dependencies"], *project("service")["dependencies"], *extras["charts"], *extras["dev"]]
    assert constrained == {requirement_name(each) for each in needed} - {"intrasplat", "intrasplat-client"}


def test_the_constraint_on_torch_is_the_projects_range() -> None:
    torch = [each for each in project()["dependencies"] if requirement_name(each) == "torch"]
    assert torch[0] in (REPOSITORY / "constraints.txt").read_text(encoding="utf-8").splitlines()


def test_triton_is_asked_for_in_the_range_that_a_gpu_is_held_to() -> None:
    after = f"{MAX_TRITON[0]}.{MAX_TRITON[1] + 1}"
    wanted = f"triton>={MIN_TRITON[0]}.{MIN_TRITON[1]},<{after}"
    extras = project()["optional-dependencies"]
    lines = (REPOSITORY / "constraints.txt").read_text(encoding="utf-8").splitlines()
    asked = [each.split(";")[0] for each in [*extras["gpu"], *extras["dev"], *lines] if each.startswith("triton")]
    assert asked == [wanted] * 3
    for page in ("docs/gpu.md", "docs/operations.md"):
        assert f"Triton {triton_range()}" in (REPOSITORY / page).read_text(encoding="utf-8"), page


def test_long_files_say_why_they_are_long() -> None:
    silent = []
    for package in ("intrasplat", "contract", "worker", "service", "client", "lab", "tests"):
        for path in sorted((REPOSITORY / package).rglob("*.py")):
            lines = path.read_text(encoding="utf-8").splitlines()
            if len(lines) > MAX_LINES and not any(re.match(r"# long: \S", each) for each in lines):
                silent.append(f"{path.relative_to(REPOSITORY)} has {len(lines)} lines")
    assert silent == [], "split them, or say why not in a line that begins '# long: '"


@pytest.mark.parametrize("path", sorted((REPOSITORY / "lab").rglob("*.py")), ids=lambda path: path.stem)
def test_the_laboratory_imports_only_names_that_exist(path: Path) -> None:
    missing = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS:
            if importlib.util.find_spec(node.module) is None:
                missing.append(node.module)
                continue
            module = importlib.import_module(node.module)
            missing += [f"{node.module}.{each.name}" for each in node.names if not hasattr(module, each.name)]
    assert missing == []
