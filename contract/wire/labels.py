"""What callers write on their jobs: a label and metadata, small texts that mean nothing to the service.

They are purged with the job, and stand in no log, metric or audit. They are not a place for names of persons.
"""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from intrasplat.errors import InputError

MAX_LABEL_CHARACTERS = 80
MAX_METADATA = 16
"""Entries."""
MAX_VALUE_CHARACTERS = 200
KEY_PATTERN = r"^[A-Za-z0-9_.:-]{1,40}$"
TEXT_PATTERN = r"^[^\u0000-\u001f\u007f-\u009f\u200e\u200f\u2028-\u202e\u2066-\u2069]*$"
"""No control characters, line separators, or marks that turn the direction in which text is written."""

LABEL_FIELD, METADATA_FIELD = "label", "metadata"
NO_NAMES = "Not for names of persons: whoever may view the job reads it."


def _named_texts(schema: dict[str, Any]) -> None:
    ((pattern, value),) = schema.pop("patternProperties").items()
    schema |= {"propertyNames": {"pattern": pattern}, "additionalProperties": value}


def _label(text: str | None) -> str | None:
    return (text and text.strip()) or None


Label = Annotated[
    Annotated[str, Field(max_length=MAX_LABEL_CHARACTERS, pattern=TEXT_PATTERN)] | None, AfterValidator(_label)
]
Key = Annotated[str, Field(pattern=KEY_PATTERN)]
Value = Annotated[str, Field(max_length=MAX_VALUE_CHARACTERS, pattern=TEXT_PATTERN)]
Metadata = Annotated[
    dict[Key, Value],
    Field(
        max_length=MAX_METADATA,
        # pydantic would write patternProperties, which generators of clients do not read
        json_schema_extra=_named_texts,
    ),
]

LABEL_ABOUT = f"a short text to find the job by. {NO_NAMES}"
METADATA_ABOUT = f"texts by name, such as an id in another system. {NO_NAMES}"


class Labels(BaseModel):
    """The label and the metadata of a job."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    label: Label = Field(default=None, description=LABEL_ABOUT)
    metadata: Metadata = Field(default={}, description=METADATA_ABOUT)

    def changed(self, change: LabelChange) -> Labels:
        """The labels after a change."""
        update: dict[str, Any] = {}
        if LABEL_FIELD in change.model_fields_set:
            update[LABEL_FIELD] = change.label
        if METADATA_FIELD in change.model_fields_set:
            update[METADATA_FIELD] = change.metadata or {}
        return self.model_copy(update=update)

    def found_by(self, word: str) -> bool:
        """Whether a word, folded by `folded`, is in the label or in a value."""
        return any(word in folded(text) for text in (self.label or "", *self.metadata.values()))


class LabelChange(BaseModel):
    """A change of a job's labels. A field that is left out stays; one that is given takes the place of what was there,
    and null removes it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    label: Label = Field(default=None, description=LABEL_ABOUT)
    metadata: Metadata | None = Field(default=None, description=METADATA_ABOUT)


def folded(text: str) -> str:
    """Text as it is compared: without regard to case and to how accents are encoded."""
    return unicodedata.normalize("NFKC", text).casefold()


def parse_labels(label: str | None, metadata: str | Mapping[str, object] | None) -> Labels:
    """Labels as a caller gives them.

    Args:
        metadata: JSON text, or the object itself.

    Raises:
        InputError: names label or metadata, or the entry of it.
    """
    try:
        given = json.loads(metadata) if isinstance(metadata, str) else metadata
    except (ValueError, RecursionError):
        raise InputError(METADATA_FIELD, "it is not JSON.", METADATA_REMEDY) from None
    values = {LABEL_FIELD: label, METADATA_FIELD: given}
    try:
        return Labels.model_validate({name: value for name, value in values.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        field = str(first["loc"][0])
        remedy = LABEL_REMEDY if field == LABEL_FIELD else METADATA_REMEDY
        raise InputError(field, f"{first['msg']}.", remedy) from error


LABEL_REMEDY = f"Give one line of at most {MAX_LABEL_CHARACTERS} characters."
METADATA_REMEDY = (
    f'Give an object of at most {MAX_METADATA} texts, such as {{"series": "0815"}}: names of 1 to 40 letters, digits, '
    f"'_', '.', ':' and '-', values of one line and at most {MAX_VALUE_CHARACTERS} characters."
)
