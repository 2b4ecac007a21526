"""How deep a text file nests, told without a parser: parsers of JSON, YAML and XML call themselves for every level."""

from __future__ import annotations

import re

_BRACKETS = re.compile(r"[\[\]{}]")


def nesting(text: str) -> int:
    """An upper bound of the levels of JSON, YAML and XML in a text: brackets, open tags, keys and dashes in one line.

    Levels that YAML tells by indentation are not counted: a file of a megabyte cannot have many.
    """
    return max(_of_brackets(text), _of_tags(text), max(map(_of_line, text.splitlines()), default=0))


def _of_brackets(text: str) -> int:
    depth = deepest = 0
    for found in _BRACKETS.finditer(text):
        depth += 1 if found.group() in "[{" else -1
        deepest = max(deepest, depth)
    return deepest


def _of_tags(text: str) -> int:
    depth = deepest = 0
    for tag in text.split("<")[1:]:
        if tag.startswith("/"):
            depth -= 1
        elif not tag.startswith(("?", "!")) and not tag.partition(">")[0].endswith("/"):
            depth += 1
            deepest = max(deepest, depth)
    return deepest


def _of_line(line: str) -> int:
    """The most keys and dashes in a row: `- - a: b: 1` has four."""
    run = longest = 0
    for word in line.split():
        run = run + 1 if word == "-" or word.endswith(":") else 0
        longest = max(longest, run)
    return longest
