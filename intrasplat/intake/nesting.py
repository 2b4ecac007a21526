"""How deep a text seems to nest, told without a parser: those of JSON, YAML and XML call themselves for every level.

What hides its levels passes, and the parsers have to bear it: json raises RecursionError, and OpenCV reads in the
process that decodes clips, whose death fails one job.
"""

from __future__ import annotations

import re

_SQUARE = bytes.maketrans(b"{}", b"[]")
_BRACKETS = b"[]{}"
_OTHERS = bytes(set(range(256)) - set(_BRACKETS))
_EMPTY_TAG = re.compile(rb"<[^<>]*/>")
_SIGNS_OF_TAGS = ((b"</", b"]"), (b"<?", b""), (b"<!", b""), (b"<", b"["))
MAX_COUNTED = 100
"""More levels than a file of ours has. What nests deeper is told as deep as the brackets that are left are many."""


def nesting(text: str) -> int:
    """The levels of JSON, YAML and XML in a text by its signs: brackets, open tags, keys and dashes in one line.

    No bound: signs in strings and in comments count as others do, so they may open levels that are none, and close some
    that are. Levels that YAML tells by indentation are not counted: a file of a megabyte cannot have many.
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
    """Levels of square brackets, those that nothing closes included.

    The innermost pairs are taken out again and again. A loop over the brackets would take a hundred times as long, and
    other threads would wait for it.
    """
    levels = 0
    while levels < MAX_COUNTED and b"[]" in brackets:
        brackets = brackets.replace(b"[]", b"")
        levels += 1
    return levels + brackets.count(b"[")


def _of_line(line: str) -> int:
    """The most keys and dashes in a row: `- - a: b: 1` has four."""
    run = longest = 0
    for word in line.split():
        run = run + 1 if word == "-" or word.endswith(":") else 0
        longest = max(longest, run)
        if longest > MAX_COUNTED:
            break
    return longest
