"""Labels and metadata: what they may be."""

from __future__ import annotations

import pytest

from contract.wire.labels import LabelChange, Labels, folded, parse_labels
from intrasplat.errors import InputError


def test_labels_are_short_texts_by_name() -> None:
    labels = parse_labels("  series 3 ", '{"ris:id": "0815", "note": ""}')
    assert labels == Labels(label="series 3", metadata={"ris:id": "0815", "note": ""})
    assert parse_labels(None, None) == parse_labels(" ", "{}") == Labels()


@pytest.mark.parametrize(
    ("label", "metadata", "field"),
    [
        ("x" * 81, None, "label"),
        ("two\nlines", None, "label"),
        ("turned \u202e round", None, "label"),
        ("a\u2028b", None, "label"),
        (None, "[1]", "metadata"),
        (None, "{", "metadata"),
        (None, "[" * 100_000, "metadata"),
        (None, '{"a": 1}', "metadata"),
        (None, '{"a": {"b": "c"}}', "metadata"),
        (None, '{"": "c"}', "metadata"),
        (None, '{"a b": "c"}', "metadata"),
        (None, '{"a": "\\u0000"}', "metadata"),
        (None, '{"a": "\\ud800"}', "metadata"),
        (None, '{"a": "%s"}' % ("x" * 201), "metadata"),
        (None, {str(i): "" for i in range(17)}, "metadata"),
    ],
)
def test_what_is_too_long_or_of_another_kind_is_refused_by_name(
    label: str | None, metadata: str | dict[str, object] | None, field: str
) -> None:
    with pytest.raises(InputError) as caught:
        parse_labels(label, metadata)
    assert caught.value.field == field
    assert caught.value.remedy


def test_a_change_leaves_what_it_does_not_name() -> None:
    labels = Labels(label="a", metadata={"b": "c"})
    assert labels.changed(LabelChange()) == labels
    assert labels.changed(LabelChange(label="")) == Labels(metadata={"b": "c"})
    assert labels.changed(LabelChange(metadata=None)) == Labels(label="a")
    assert labels.changed(LabelChange(metadata={"d": "e"})) == Labels(label="a", metadata={"d": "e"})


def test_words_are_found_whatever_their_case_and_accents_encoding() -> None:
    labels = Labels(label="Übung", metadata={"name": "Café"})
    assert labels.found_by(folded("U\u0308BUNG"))
    assert labels.found_by(folded("cafe\u0301"))
    assert not labels.found_by(folded("name"))
