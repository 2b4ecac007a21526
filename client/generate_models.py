"""Write intrasplat_client/models.py: the service's types, generated from contract/wire.

python -m client.generate_models
"""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import Any

from pydantic.json_schema import models_json_schema

from contract.wire.cameras import SceneCameras
from contract.wire.exports import ExportOffer
from contract.wire.feeds import CutRange, FeedReceipt, FeedView
from contract.wire.job import TERMINAL_STATES, JobView
from contract.wire.webhooks import Delivery
from intrasplat.measuring import Measurement
from intrasplat.options import JobOptions
from intrasplat.report import Report

MODELS = Path(__file__).resolve().parent / "intrasplat_client" / "models.py"
READ = (JobView, Delivery, Report, SceneCameras, Measurement, FeedView, FeedReceipt, CutRange, ExportOffer)
"""Types that the service answers with; the types that they contain are added."""
CLOSED = ("JobState",)
"""Enumerations of which a reader must know every member. Unknown members of all others are read as text."""
GIVEN_ALSO = {"holdout": "list[int]"}
"""Forms that the service accepts besides the schema's."""
EXCLUSIVE_OPTIONS = (JobOptions.exclusive,)
COLUMNS = 116

HEAD = '''\
"""The service's types. Generated from contract/wire by `python -m client.generate_models`; do not edit."""
# long: generated; it holds every type of the API

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, with_config
from typing_extensions import TypedDict


class Model(BaseModel):
    """Accepts and keeps fields that it does not know, so that this client can read the answers of a newer service."""

    model_config = ConfigDict(frozen=True, extra="allow")
'''
GIVEN = '''
@with_config(ConfigDict(extra="forbid"))
class GivenOptions(TypedDict, total=False):
    """What a caller may choose about a reconstruction: the keyword arguments of Client.reconstruct."""
'''
SCALARS = {"string": "str", "integer": "int", "number": "float", "boolean": "bool", "null": "None"}
BOUNDS = {
    "minimum": "ge",
    "maximum": "le",
    "exclusiveMinimum": "gt",
    "exclusiveMaximum": "lt",
    "maxLength": "max_length",
    "pattern": "pattern",
}


def main() -> int:
    """Write the file."""
    MODELS.write_text(generate(), encoding="utf-8")
    return 0


def definitions() -> dict[str, Any]:
    """The JSON schema of each type that the service answers with, by name."""
    _, document = models_json_schema([(each, "validation") for each in READ])
    schemas: dict[str, Any] = document["$defs"]
    return schemas


def generate() -> str:
    """The whole file, formatted."""
    schemas = definitions()
    enums = {name: schema for name, schema in schemas.items() if "enum" in schema}
    open_enums = {*enums} - {*CLOSED}
    states = ", ".join(f"JobState.{state.name}" for state in sorted(TERMINAL_STATES))
    parts = [
        HEAD,
        *("".join(_enum(name, schema)) for name, schema in enums.items()),
        *("".join(_model(name, schema, open_enums)) for name, schema in schemas.items() if name not in enums),
        f'TERMINAL_STATES = frozenset({{{states}}})\n"""States that a job does not leave by itself."""\n',
        f'EXCLUSIVE_OPTIONS = {EXCLUSIVE_OPTIONS!r}\n"""At most one option of each group may be given."""\n',
        "".join(_given(schemas[JobOptions.__name__])),
    ]
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", MODELS.name, "--line-length", "120", "-"]
    return subprocess.run(command, input="\n\n".join(parts), capture_output=True, text=True, check=True).stdout


def _enum(name: str, schema: Mapping[str, Any]) -> Iterator[str]:
    yield f"class {name}(StrEnum):\n" + _docstring(schema["description"]) + "\n"
    for value in schema["enum"]:
        yield f"    {_member(value)} = {value!r}\n"


def _model(name: str, schema: Mapping[str, Any], open_enums: Set[str]) -> Iterator[str]:
    yield f"class {name}(Model):\n" + _docstring(schema["description"]) + "\n"
    required = schema.get("required", ())
    for field, kind in schema["properties"].items():
        default = "" if field in required else f" = {_default(kind)}"
        yield f"    {field}: {_read_type(kind, open_enums)}{default}\n" + _docstring(kind.get("description"))


def _given(schema: Mapping[str, Any]) -> Iterator[str]:
    yield GIVEN + "\n"
    for field, kind in schema["properties"].items():
        also = f" | {GIVEN_ALSO[field]}" if field in GIVEN_ALSO else ""
        yield f"    {field}: {_given_type(kind)}{also}\n" + _docstring(kind.get("description"))


def _read_type(kind: Mapping[str, Any], open_enums: Set[str]) -> str:
    """The type of a field that the service sends, without bounds or choices, which a later version may extend."""
    if "$ref" in kind:
        name = _name_of(kind)
        return f'Annotated[{name} | str, Field(union_mode="left_to_right")]' if name in open_enums else name
    if "anyOf" in kind:
        return " | ".join(_read_type(each, open_enums) for each in kind["anyOf"])
    if kind["type"] == "array":
        return f"tuple[{_read_type(kind['items'], open_enums)}, ...]"
    if kind["type"] == "object":
        return f"dict[str, {_read_type(kind['additionalProperties'], open_enums)}]"
    return SCALARS[kind["type"]]


def _given_type(kind: Mapping[str, Any]) -> str:
    """The type of a field that a caller gives, with choices and bounds."""
    if "anyOf" in kind:
        return " | ".join(_given_type(each) for each in kind["anyOf"])
    if "enum" in kind:
        return f"Literal[{', '.join(map(repr, kind['enum']))}]"
    bounds = ", ".join(f"{BOUNDS[key]}={value!r}" for key, value in kind.items() if key in BOUNDS)
    scalar = SCALARS[kind["type"]]
    return f"Annotated[{scalar}, Field({bounds})]" if bounds else scalar


def _default(kind: Mapping[str, Any]) -> str:
    value = kind["default"]
    if "$ref" in kind:
        return f"{_name_of(kind)}.{_member(value)}"
    if isinstance(value, list):
        return repr(tuple(value))
    return f"Field(default={value!r})" if isinstance(value, dict) else repr(value)


def _docstring(text: str | None) -> str:
    if text is None:
        return ""
    indent = " " * 4
    paragraphs = [textwrap.wrap(" ".join(each.split()), COLUMNS - 8) for each in text.split("\n\n")]
    lines = [line for each in paragraphs for line in (*each, "")][:-1]
    closing = f"\n{indent}" if len(lines) > 1 else ""
    body = "\n".join((indent + line).rstrip() for line in lines).strip()
    return f'{indent}"""{body}{closing}"""\n'


def _name_of(reference: Mapping[str, Any]) -> str:
    name: str = reference["$ref"].rpartition("/")[2]
    return name


def _member(value: str) -> str:
    return value.upper().replace("-", "_")


if __name__ == "__main__":
    sys.exit(main())
