"""Decodes the text of a calibration file in the encodings that people's editors write, and names the file in errors."""

from __future__ import annotations

import codecs
from collections.abc import Iterator
from contextlib import contextmanager

from intrasplat.errors import InputError

_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_CONTROLS = frozenset(map(chr, range(32))) - set("\t\n\r\f") | {"\x7f"}
_MIN_ASCII_SHARE = 0.5
"""Binary files read as UTF-16 are mostly rare characters."""


def decoded_text(data: bytes) -> str | None:
    """The text in UTF-8, UTF-16 (with its mark) or Latin-1; None if the data are no text."""
    try:
        text = data.decode("utf-16" if data.startswith(_UTF_16) else "utf-8-sig")
    except UnicodeDecodeError:
        if data.startswith(_UTF_16):
            return None
        text = data.decode("latin-1")
    ascii_share = sum(map(str.isascii, text)) / max(1, len(text))
    return None if _CONTROLS.intersection(text) or ascii_share < _MIN_ASCII_SHARE else text


@contextmanager
def named_errors(label: str) -> Iterator[None]:
    """Put the file's name before the problem of an InputError."""
    try:
        yield
    except InputError as error:
        raise type(error)(error.field, f"{label}: {error.problem}", error.remedy) from None
