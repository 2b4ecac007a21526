"""The page: everything it needs lies beside it, nothing in it would be stopped by its own security policy."""

from __future__ import annotations

import html
import re
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from typing import get_args

import pytest

from client.generate_page import PAGE_TYPES, generate
from client.page import DASHBOARD
from intrasplat.options import JobOptions
from tests.client.words import table
from tests.service.under_test import running_service

SERVER_PROJECT = DASHBOARD.parents[1] / "service" / "pyproject.toml"
SCRIPTS = sorted(DASHBOARD.rglob("*.js"))
INDEX, ALONE, LIVE = DASHBOARD / "index.html", DASHBOARD / "file" / "alone.html", DASHBOARD / "live.html"
pages = pytest.mark.parametrize("path", [INDEX, ALONE, LIVE], ids=lambda path: path.name)
"""The page of a service, the page of a file without one, and the live screen."""
PARTS = {"base", "form", "library", "measure", "stage"}
FOLDERS = {INDEX: {"dashboard", *PARTS}, ALONE: {"file"}, LIVE: {"live"}}
"""Where the scripts are that look for elements of each page."""


class Page(HTMLParser):
    """Ids, references and inline code of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.references: list[str] = []
        self.inline: list[str] = []
        self._tag = ""
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._tag = tag
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href"):
                self.references.append(value or "")
            if name == "style" or name.startswith("on"):
                self.inline.append(f"{tag} {name}")

    def handle_data(self, data: str) -> None:
        if self._tag in ("script", "style") and data.strip():
            self.inline.append(data)


def imports_of(script: Path) -> list[str]:
    return re.findall(r'from "([^"]+)"', script.read_text())


@pages
def test_the_page_refers_only_to_files_beside_it(path: Path) -> None:
    assert [each for each in Page(path).references if not (path.parent / each).is_file()] == []


@pages
def test_the_page_holds_no_inline_code_that_its_policy_would_stop(path: Path) -> None:
    assert Page(path).inline == []


def test_the_page_says_that_it_is_no_medical_device() -> None:
    assert "Not a medical device" in (DASHBOARD / "index.html").read_text()
    assert 'data-words="page.notice"' in LIVE.read_text()


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_a_script_imports_only_scripts_of_the_page_and_names_that_they_export(script: Path) -> None:
    for names, module in re.findall(r'import \{([^}]+)\} from "([^"]+)"', script.read_text()):
        source = (script.parent / module).resolve()
        assert source.is_relative_to(DASHBOARD)
        for name in (each.strip() for each in names.split(",")):
            exported = rf"export (async )?(const|function|class) {name}\b"
            assert re.search(exported, source.read_text()), f"{module} exports no {name}"
    assert [module for module in imports_of(script) if not module.startswith(("./", "../"))] == []


def test_the_player_knows_nothing_of_the_page() -> None:
    for script in (DASHBOARD / "player").glob("*.js"):
        assert [module for module in imports_of(script) if not module.startswith("./")] == [], script.name
        assert not re.search(r"document\.(query|getElement|body)", script.read_text()), script.name
        workers = re.findall(r'new URL\("\./([^"]+)"', script.read_text())
        assert [each for each in workers if not (script.parent / each).is_file()] == []


@pages
def test_every_element_that_a_script_asks_for_is_on_the_page(path: Path) -> None:
    page, scripts = Page(path), [each for each in SCRIPTS if each.parent.name in FOLDERS[path]]
    asked = {each for script in scripts for each in re.findall(r'(?<!\.)\bget\("([^"]+)"\)', script.read_text())}
    assert asked <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))


def test_nothing_is_fetched_from_elsewhere() -> None:
    for path in (*SCRIPTS, *DASHBOARD.rglob("*.css"), INDEX, ALONE, LIVE):
        assert not re.search(r"(https?:)?//[a-z0-9.-]+\.[a-z]{2,}/", path.read_text()), path.name


def test_the_types_and_limits_are_what_contract_wire_generates() -> None:
    assert PAGE_TYPES.read_text(encoding="utf-8") == generate(), "run: python -m client.generate_page"


def test_the_form_has_words_for_each_choice_and_a_field_for_options_alone() -> None:
    page, script = (DASHBOARD / "index.html").read_text(), (DASHBOARD / "form/options.js").read_text()
    (listed,) = re.findall(r"const OPTIONS = \[(.*?)\n\];", script, re.DOTALL)
    named = set()
    for name in re.findall(r'"(\w+)"', listed):
        assert f'name="{name}"' in page
        choices = get_args(JobOptions.model_fields[name].annotation)
        named |= {f"{name}_{each}" for each in choices if isinstance(each, str)}
    assert set(table("en")["choice"]) == named


def test_the_server_package_has_every_file_of_the_page() -> None:
    """Patterns of setuptools' package data, which match files alone."""
    project = tomllib.loads(SERVER_PROJECT.read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["client"]
    packaged = {path for pattern in patterns for path in DASHBOARD.parent.glob(pattern) if path.is_file()}
    assert {path for path in DASHBOARD.rglob("*") if path.is_file()} <= packaged


@pytest.mark.parametrize(("accepted", "language"), [("de-CH,de;q=0.9,en;q=0.8", "de"), ("fr, en", "en"), ("", "en")])
def test_the_page_comes_with_its_words_and_one_script(tmp_path: Path, accepted: str, language: str) -> None:
    for service in running_service(tmp_path, dashboard_dir=DASHBOARD):
        answer = service.http.get("/", headers={"Accept-Language": accepted})
        text, words = answer.text, table(language)
        assert f'<html lang="{language}">' in text
        assert "Accept-Language" in answer.headers["Vary"]
        places = re.findall(r'data-words="(\w+)\.(\w+)"[^>]*>([^<]*)', text)
        assert len(places) > 50
        assert [html.unescape(shown) for *_, shown in places] == [words[section][code] for section, code, _ in places]
        (script,) = re.findall(r'<script type="module" src="([^"]+)"', text)
        joined = service.http.get("/" + script)
        assert "immutable" in joined.headers["Cache-Control"]
        assert "import {" not in joined.text
        assert "export const { viewer, jobs } =" in joined.text
        assert "class Drawing" in joined.text  # which only others import
        assert "class Brush " not in joined.text  # which is loaded when it is wanted
        later = service.http.get("/" + script.replace("main.js", "masks/brush.js")).text
        assert re.match(r'import \{ [\w, ]+ \} from "\./\.\./main.js";\n', later)
        assert service.http.get("/" + script, headers={"Accept-Encoding": "identity"}).text == joined.text
        assert "import {" in service.http.get("/main.js").text
        live = service.http.get(
            "/" + re.findall(r'<script type="module" src="([^"]+)"', service.http.get("/live.html").text)[0]
        )
        assert "class Orbit " in live.text
        assert "class Compare " not in live.text
