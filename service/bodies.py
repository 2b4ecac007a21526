"""The bodies of POST /reconstruct, POST /scenes and /feeds as /openapi.json describes them: schemas with names."""

from __future__ import annotations

from typing import Any

from pydantic.json_schema import models_json_schema

from contract.wire.checks import DescribedClip
from contract.wire.feeds import GivenCut
from contract.wire.labels import Labels
from contract.wire.webhooks import CALLBACK_ABOUT, CALLBACK_PART, MAX_CALLBACK_CHARACTERS
from intrasplat.names import JOB_ID_PATTERN
from service.upload import CLIP_OF, PARTS, SUFFIXES

EXAMPLE_ID = "0123456789abcdef0123456789abcdef"
BINARY: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
"""The content of an answer that is a file."""
TEXT: dict[str, Any] = {"schema": {"type": "string"}}
ONE_CLIP = "clip, or left and right, or clip_of"
ABOUT = {
    "clip": "both eyes in one file, or the left one alone with its depth",
    "left": "the left eye, with right",
    "right": "the right eye, with left",
    "calibration": "of the cameras",
    "masks": "where instruments are",
    "poses_file": "the camera's poses: TUM, or a matrix a frame",
    "fov_mask": "the field of view, white inside: of the left eye, or of both side by side",
}
CLIP_OF_ID = {
    "type": "string",
    "pattern": JOB_ID_PATTERN,
    "description": "a job whose clip is used again, with its other files unless others are sent",
}
CALLBACK_URL = {
    "type": "string",
    "format": "uri",
    "maxLength": MAX_CALLBACK_CHARACTERS,
    "description": CALLBACK_ABOUT,
}
OPTIONS = {"$ref": "#/components/schemas/JobOptions"}


def _of_file(part: str) -> dict[str, Any]:
    endings = ", ".join(SUFFIXES[part])
    return {"type": "string", "format": "binary", "description": f"{ABOUT[part]}; its name ends in {endings}"}


def _of_upload(part: str) -> dict[str, Any]:
    return {"type": "string", "pattern": JOB_ID_PATTERN, "description": f"{ABOUT[part]}: a finished upload's id"}


def _body(title: str, about: str, parts: dict[str, Any]) -> dict[str, Any]:
    labels = Labels.model_json_schema()["properties"]
    text = next(each for each in labels["label"]["anyOf"] if each["type"] == "string")  # a form has no null
    labels["label"] = {**text, "description": labels["label"]["description"]}
    properties = {**parts, CLIP_OF: CLIP_OF_ID, **labels, CALLBACK_PART: CALLBACK_URL, "options": OPTIONS}
    description = f"{about}: {ONE_CLIP}, and what else is known."
    return {
        "title": title,
        "description": description,
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


SCENE_FORM: dict[str, Any] = {
    **_body("SceneForm", "A scene of another installation", {}),
    "description": "A scene that another installation exported with format=scene, and what else is known.",
    "required": ["scene"],
}
SCENE_FORM["properties"] = {
    "scene": {"type": "string", "format": "binary", "description": "the archive; its name ends in .zip"},
    **{name: each for name, each in SCENE_FORM["properties"].items() if name != CLIP_OF},
}

FEED_FORM: dict[str, Any] = {
    "title": "FeedForm",
    "description": "A live feed to be opened.",
    "type": "object",
    "properties": {"calibration": _of_file("calibration"), "options": {"$ref": "#/components/schemas/FeedOptions"}},
    "required": ["calibration"],
    "additionalProperties": False,
}

BODIES: dict[str, dict[str, Any]] = {
    "ClipForm": _body("ClipForm", "A clip in one request", {part: _of_file(part) for part in PARTS}),
    "ClipOfUploads": _body(
        "ClipOfUploads", "A clip of finished uploads (POST /uploads)", {part: _of_upload(part) for part in PARTS}
    ),
    **models_json_schema(
        [(DescribedClip, "validation"), (GivenCut, "validation")], ref_template="#/components/schemas/{model}"
    )[1]["$defs"],
    "SceneForm": SCENE_FORM,
    "FeedForm": FEED_FORM,
}
"""Schemas by name. They do not say which parts go together, because generators do not read conditions."""

JSON_PARTS = {name: {"contentType": "application/json"} for name in ("options", "metadata")}
SCENE_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "the archive; options may hold priority and retention_hours alone",
        "content": {
            "multipart/form-data": {"schema": {"$ref": "#/components/schemas/SceneForm"}, "encoding": JSON_PARTS}
        },
    }
}
FEED_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "the calibration, and where the video is; without options.source it is pushed",
        "content": {
            "multipart/form-data": {
                "schema": {"$ref": "#/components/schemas/FeedForm"},
                "encoding": {"options": {"contentType": "application/json"}},
            }
        },
    }
}
CUT_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {"$ref": "#/components/schemas/GivenCut"},
                "example": {"from": -30, "to": "live", "options": {"budget_s": 60}},
            }
        },
    }
}
VIDEO_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "fragmented mp4, MPEG-TS or Matroska, for as long as it goes on",
        "content": {"application/octet-stream": BINARY},
    }
}
REQUEST_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": f"{ONE_CLIP}; a file name's ending tells the format",
        "content": {
            "multipart/form-data": {
                "schema": {"$ref": "#/components/schemas/ClipForm"},
                "encoding": JSON_PARTS,
            },
            "application/json": {
                "schema": {"$ref": "#/components/schemas/ClipOfUploads"},
                "example": {"clip": EXAMPLE_ID, "options": {"budget_s": 20}},
            },
        },
    }
}
"""The request body that the route adds to its description."""
