"""The page's tables of words, as the tests read them."""

from __future__ import annotations

import json
from functools import cache

from client.page import DASHBOARD

LANGUAGES = ("en", "de")


@cache
def table(language: str) -> dict[str, dict[str, str]]:
    """The page's words, by section and code."""
    text = (DASHBOARD / "base" / f"messages.{language}.js").read_text(encoding="utf-8")
    found: dict[str, dict[str, str]] = json.loads(text[text.index("{") : text.rindex("}") + 1])
    return found


def say(place: str, language: str = "en", **values: object) -> str:
    """What the page says at a place such as "stage.train"."""
    section, _, code = place.partition(".")
    return table(language)[section][code].format_map(values)
