"""docs/codes.md lists every code of a notice, an error and a refusal, and no other; each class of error has a code."""

from __future__ import annotations

import re
from collections.abc import Iterator

import intrasplat.files.disk_errors  # noqa: F401
import worker.reply  # noqa: F401
from contract.wire.checks import FindingCode
from contract.wire.webhooks import TryFailure
from intrasplat.errors import ErrorCode, IntrasplatError
from intrasplat.live.state import FeedReason
from intrasplat.measuring import RefusalCode
from intrasplat.notices import NoticeCode
from tests.test_repository import REPOSITORY

PAGE, ERRORS, REFUSALS, TRIES, FEEDS = re.split(
    "## (?:Errors|Refusals|Tries of a webhook|Feeds)", (REPOSITORY / "docs" / "codes.md").read_text(encoding="utf-8")
)
NOTICES, FINDINGS = PAGE.split("## Findings")
SOURCES = [
    path for folder in ("intrasplat", "contract", "worker", "service") for path in (REPOSITORY / folder).rglob("*.py")
]


def listed(page: str) -> list[str]:
    return re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)


def classes_below(parent: type[IntrasplatError]) -> Iterator[type[IntrasplatError]]:
    for each in parent.__subclasses__():
        yield each
        yield from classes_below(each)


def test_every_code_of_a_notice_is_explained_once_and_no_other() -> None:
    assert sorted(listed(NOTICES)) == sorted(NoticeCode)


def test_every_code_of_an_error_is_explained_once_and_no_other() -> None:
    assert sorted(listed(ERRORS)) == sorted(ErrorCode)


def test_every_code_of_a_finding_is_explained_once_and_no_other() -> None:
    assert sorted(listed(FINDINGS)) == sorted(FindingCode)


def test_every_code_of_a_refusal_is_explained_once_and_no_other() -> None:
    assert sorted(listed(REFUSALS)) == sorted(RefusalCode)


def test_every_code_of_a_failed_try_of_a_webhook_is_explained_once_and_no_other() -> None:
    assert sorted(listed(TRIES)) == sorted(TryFailure)


def test_every_reason_of_a_feed_is_explained_once_and_no_other() -> None:
    assert sorted(listed(FEEDS)) == sorted(FeedReason)


def test_every_class_of_error_has_a_code_of_its_own() -> None:
    ours = [each for each in classes_below(IntrasplatError) if not each.__module__.startswith("tests")]
    without = [each.__name__ for each in ours if "code" not in vars(each)]
    assert without == []
    assert len({each.code for each in ours}) == len(ours)


def test_every_notice_is_raised_with_the_severity_that_the_page_names() -> None:
    sources = [*SOURCES, *(REPOSITORY / "lab" / "phantom").glob("*.py")]  # synthetic clips say that they are
    text = "\n".join(path.read_text(encoding="utf-8") for path in sources)
    raised = set(re.findall(r"Notice\.(info|warning)\(\s*NoticeCode\.(\w+)", text))
    explained = re.findall(r"^\| `(\w+)` \| (info|warning) \|", NOTICES, re.MULTILINE)
    assert raised == {(severity, code.upper()) for code, severity in explained}
