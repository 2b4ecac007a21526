"""The page's words: every code of the contract has both languages, and none of them speaks to machines."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from client.page import DASHBOARD
from contract.wire.checks import FindingCode
from contract.wire.job import JobState
from intrasplat.errors import ErrorCode
from intrasplat.machine.forecast import COMPILATION, USUAL_S
from intrasplat.notices import NoticeCode
from intrasplat.quality.score import STAGE
from service.problems import TITLES
from tests.client.words import LANGUAGES, table
from tests.test_codes import NOTICES
from worker.consume import PUBLISHING
from worker.orders import FETCHING

API_WORDS = re.compile(
    r"\b(GET|POST|PUT|PATCH|DELETE|HEAD)\b|/(jobs|scenes|render|uploads|key|reconstruct)\b|\w=\w|https?:|\bJSON\b"
    r"|Authorization|Bearer|INTRASPLAT_|\w+_\w+|`|intrasplat \w+|[0-9a-f]{12}"
)
"""What programs and those who run a service read: routes, queries, headers, names of fields and settings, ids."""

SCRIPTS = [script for script in sorted(DASHBOARD.rglob("*.js")) if not re.match(r"messages\.\w\w\.js", script.name)]
STATUS_WITH_CODE = {413: "limit", 422: "input", 501: "missing_extra", 507: "store_full"}
"""As in problem.js."""


def places() -> Iterator[tuple[str, str, str]]:
    for language in LANGUAGES:
        for section, texts in table(language).items():
            yield from ((language, f"{section}.{code}", text) for code, text in texts.items())


def names_in(text: str) -> list[str]:
    return sorted(re.findall(r"\{(\w+)\}", text))


def test_both_languages_have_the_same_places_and_name_the_same_values() -> None:
    english, german = (
        {place: names_in(text) for each, place, text in places() if each == language} for language in LANGUAGES
    )
    assert english == german


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_code_of_the_contract_has_words(language: str) -> None:
    words = table(language)
    assert set(words["notice"]) == {code.value for code in NoticeCode}
    assert {code.value for code in ErrorCode} <= set(words["problem"])
    assert set(words["check"]) == {code.value for code in FindingCode}
    assert set(words["state"]) == {state.value for state in JobState}
    assert set(words["stage"]) == {*USUAL_S, COMPILATION, STAGE, FETCHING, PUBLISHING}
    statuses = {STATUS_WITH_CODE.get(status, f"http_{status}") for status in TITLES}
    assert statuses <= set(words["problem"])


def test_no_word_for_machines_is_said_to_people() -> None:
    assert [(place, text) for _, place, text in places() if API_WORDS.search(re.sub(r"\{\w+\}", "", text))] == []


def test_every_sentence_ends_and_none_is_empty() -> None:
    sentences = [text for _, place, text in places() if place.startswith(("notice.", "problem."))]
    assert [text for text in sentences if not text.endswith(".")] == []
    assert [place for _, place, text in places() if not text.strip()] == []


def test_scripts_and_page_ask_for_words_that_are_there_and_for_all_of_them() -> None:
    known = {place for _, place, _ in places()}
    sections = "|".join(table("en"))
    source = "".join(script.read_text(encoding="utf-8") for script in SCRIPTS)
    source += "".join(page.read_text(encoding="utf-8") for page in DASHBOARD.rglob("*.html"))
    asked = set(re.findall(rf'"((?:{sections})\.[a-z_0-9:]+)"', source))
    beginnings = tuple(set(re.findall(rf"`((?:{sections})\.[a-z_]*)\$\{{", source)))
    endings = re.findall(r'\["(\w+)", ', (DASHBOARD / "library/figures.js").read_text(encoding="utf-8"))
    assert {f"figure.{each}" for each in endings} <= known
    assert asked - known == set()
    assert [place for place in known - asked if not place.startswith(beginnings)] == []


def test_a_warning_of_every_code_has_one_weight_in_the_traffic_light() -> None:
    source = (DASHBOARD / "library/trustlight.js").read_text(encoding="utf-8")
    (weights,) = re.findall(r"const WEIGHTS = \{(.*?)\};", source, re.DOTALL)
    weighed = re.findall(r'"(\w+)"(?!:)', weights)
    of_warnings = re.findall(r"^\| `(\w+)` \| (?:warning|either) \|", NOTICES, re.MULTILINE)
    assert sorted(weighed) == sorted(of_warnings)
