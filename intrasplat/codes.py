"""Read codes that another version may have written."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BeforeValidator


def known_code(codes: type[StrEnum]) -> BeforeValidator:
    """A validator for a field with one of the codes: an unknown code, as of a later version, becomes `unclassified`."""
    known = {code.value for code in codes}

    def read(code: object) -> object:
        return code if not isinstance(code, str) or code in known else "unclassified"

    return BeforeValidator(read)
