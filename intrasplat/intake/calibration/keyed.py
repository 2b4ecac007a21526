"""Reads numbers by key from JSON and YAML as people write them: nested lists, OpenCV matrices, comments, tabs.

It is no parser of all of YAML: a calibration is keys with numbers, so only keys, numbers and brackets count.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import FIELD
from intrasplat.intake.calibration.names import name_below

_TOKEN = re.compile(
    r"(?P<comment>(?:(?<=\s)|^)(?:#|//).*)"
    r"|(?P<key>[A-Za-z_][\w.-]*|\"[^\"]*\"|'[^']*')\s*:(?=[\s\[{\"'!\d.+-]|$)"
    r"|(?P<bracket>[\[\]{}])"
    r"|(?P<word>\"[^\"]*\"|'[^']*'|[^\s\[\]{},:\"']+)"
)
"""What a line holds. It takes linear time: where a key is none, the word there is skipped as a whole."""

_OF_MATRIX = frozenset({"rows", "cols", "sizes", "dt", "data", "type_id"})
_MAX_PARENTS = 16  # keys above a key; a calibration has two
_NOT_FINITE = frozenset({"nan", "inf", "infinity"})


@dataclass
class Entry:
    """The numbers of one key, as written in the file. line counts from 1, and is None where it is unknown."""

    key: str
    line: int | None = None
    numbers: list[float] = field(default_factory=list)
    announced: dict[str, int] = field(default_factory=dict)
    other: str | None = None
    """The first word that is no number."""

    def __str__(self) -> str:
        return self.key if self.line is None else f"{self.key} in line {self.line}"


@dataclass
class Keyed:
    """The known entries of a file by their names (names.NAMES), and all its keys in lower case."""

    entries: dict[str, Entry] = field(default_factory=dict)
    keys: set[str] = field(default_factory=set)

    def add(self, parent: str, entry: Entry) -> None:
        """Keep an entry whose name is known alone or with its parent's ("left", "K"). The first one counts."""
        self.keys.add(entry.key.lower())
        name = name_below(parent, entry.key)
        if name is not None:
            self.entries.setdefault(name, entry)


def keyed_json(value: Any) -> Keyed:
    """The entries of a decoded JSON value. RecursionError if it is nested too deep."""
    found = Keyed()
    _walk_json(value, "", found)
    return found


def keyed_yaml(text: str) -> Keyed:
    """The entries of a YAML text.

    Raises:
        InputError: it ends inside a list, or a matrix has not as many numbers as it announces.
    """
    found = Keyed()
    opened = {"[": 0, "{": 0}
    parents: list[tuple[tuple[int, int], Entry]] = []
    current, part = Entry(""), ""
    for line, kind, word, column in _tokens(text):
        if kind == "bracket":
            opened["[" if word in "[]" else "{"] += 1 if word in "[{" else -1
            opened = {bracket: max(0, count) for bracket, count in opened.items()}
        elif kind == "key":
            level = (opened["{"], 0 if opened["{"] else column)
            above = [entry for at, entry in parents if at < level]
            if word in _OF_MATRIX:
                current, part = above[-1] if above else current, word
                continue
            current, part = Entry(word, line), ""
            found.add(above[-1].key if above else "", current)
            parents = [*parents[: len(above)], (level, current)][:_MAX_PARENTS]
        else:
            _take(current, part, word)
    if any(opened.values()):
        raise InputError(FIELD, "the file was cut short: a list does not end.", "Copy or export it again.")
    for entry in found.entries.values():
        _check_count(entry)
    return found


def _tokens(text: str) -> Iterator[tuple[int, str, str, int]]:
    """(line, kind, text without quotes, column) of every key, bracket and word."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith(("%", "---", "...")):
            continue
        line = line.expandtabs()
        for token in _TOKEN.finditer(line):
            kind = str(token.lastgroup)
            if kind != "comment":
                yield number, kind, token[kind].strip("\"'"), token.start()


def _take(entry: Entry, part: str, word: str) -> None:
    """Add a word to an entry. part: the key of its matrix before the word; empty: there is none."""
    number = _number(word)
    if part in ("rows", "cols") and number is not None:
        entry.announced[part] = int(number) if abs(number) < 1e6 else -1
    elif part in ("", "data") and number is not None:
        entry.numbers.append(number)
    elif part in ("", "data") and word != "-" and not word.startswith("!"):
        entry.other = entry.other or word


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return float("nan") if word.lower().lstrip("+-.") in _NOT_FINITE else None


def _check_count(entry: Entry) -> None:
    rows, cols = entry.announced.get("rows"), entry.announced.get("cols")
    if rows is None or cols is None or rows * cols == len(entry.numbers):
        return
    problem = f"{entry} announces {rows} x {cols} numbers and has {len(entry.numbers)}."
    raise InputError(FIELD, problem, "Copy or export the file again; write decimals with a point.")


def _walk_json(value: Any, parent: str, found: Keyed) -> None:
    if isinstance(value, list):
        for each in value:
            _walk_json(each, parent, found)
    if not isinstance(value, dict):
        return
    for key, below in value.items():
        entry = Entry(key)
        _flatten(below["data"] if isinstance(below, dict) and "data" in below else below, entry)
        found.add(parent, entry)
        _walk_json(below, key, found)


def _float(value: float) -> float:
    """As float; infinite beyond the largest, as in JSON's 1e999."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _flatten(value: Any, entry: Entry) -> None:
    if isinstance(value, list):
        for each in value:
            _flatten(each, entry)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        entry.numbers.append(_float(value))
    elif isinstance(value, str) and (number := _number(value.strip())) is not None:
        entry.numbers.append(number)
    elif isinstance(value, str):
        entry.other = entry.other or value
