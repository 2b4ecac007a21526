"""Codes that another version may have written."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BeforeValidator


def known_code(codes: type[StrEnum]) -> BeforeValidator:
    """For a field with one of the codes: a text that is none of them, as a later version writes, is `unclassified`."""
    known = {code.value for code in codes}

    def read(code: object) -> object:
        return code if not isinstance(code, str) or code in known else "unclassified"

    return BeforeValidator(read)
