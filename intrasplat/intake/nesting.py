"""Estimates the nesting depth of a text without a parser: parsers of JSON, YAML and XML recurse for every level.

A text can hide its levels from this estimate. Then json raises RecursionError, or OpenCV's parser crashes the decoding
process, which fails one job.
"""

from __future__ import annotations

import re

_SQUARE = bytes.maketrans(b"{}", b"[]")
_BRACKETS = b"[]{}"
_OTHERS = bytes(set(range(256)) - set(_BRACKETS))
_EMPTY_TAG = re.compile(rb"<[^<>]*/>")
_SIGNS_OF_TAGS = ((b"</", b"]"), (b"<?", b""), (b"<!", b""), (b"<", b"["))
MAX_COUNTED = 100
"""More levels than a valid file has. Beyond it, the estimate is the number of remaining brackets."""


def nesting(text: str) -> int:
    """Estimated nesting depth of JSON, YAML or XML: by brackets, open tags, and keys and dashes in one line.

    It is no bound: signs in strings and comments count, too, so they may add false levels or close true ones. Levels by
    YAML indentation are not counted: a file of a megabyte cannot have many.
    """
    data = text.encode("ascii", "replace")
    deepest = max(_of_pairs(data.translate(_SQUARE, _OTHERS)), _of_tags(data))
    return deepest if deepest > MAX_COUNTED else max(deepest, max(map(_of_line, text.splitlines()), default=0))


def _of_tags(data: bytes) -> int:
    data = _EMPTY_TAG.sub(b"", data.translate(None, _BRACKETS))
    for sign, bracket in _SIGNS_OF_TAGS:
        data = data.replace(sign, bracket)
    return _of_pairs(data.translate(None, _OTHERS))


def _of_pairs(brackets: bytes) -> int:
    """Levels of square brackets, unclosed ones included.

    Innermost pairs are removed repeatedly. A Python loop over the brackets would take a hundred times as long and block
    other threads.
    """
    levels = 0
    while levels < MAX_COUNTED and b"[]" in brackets:
        brackets = brackets.replace(b"[]", b"")
        levels += 1
    return levels + brackets.count(b"[")


def _of_line(line: str) -> int:
    """The longest run of keys and dashes: `- - a: b: 1` has four."""
    run = longest = 0
    for word in line.split():
        run = run + 1 if word == "-" or word.endswith(":") else 0
        longest = max(longest, run)
        if longest > MAX_COUNTED:
            break
    return longest
