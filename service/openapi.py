"""The OpenAPI document: what FastAPI derives from the routes, and the problem that every operation may answer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

from fastapi import FastAPI
from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import models_json_schema

from contract.wire.webhooks import JobEnded
from service.bodies import BODIES, EXAMPLE_ID
from service.problems import MEDIA_TYPE

EXAMPLES: dict[str, dict[str, Any]] = {
    "JobView": {
        "id": EXAMPLE_ID,
        "state": "running",
        "stage": "train",
        "fraction": 0.4,
        "psnr_db": 33.1,
        "seconds_left": 20.0,
        "eta_s": 27.0,
        "attempt": 1,
        "options": {"budget_s": 30},
        "input_bytes": 41943040,
        "created_at_s": 1767225600.0,
        "links": {"self": f"/jobs/{EXAMPLE_ID}", "events": f"/jobs/{EXAMPLE_ID}/events"},
    },
    "Problem": {
        "type": "about:blank",
        "title": "The input cannot be used",
        "status": 422,
        "detail": "a file that ends in '.exe' is not accepted.",
        "field": "clip",
        "remedy": "Send .mp4, .mov, .mkv, .webm, .zip.",
    },
}
REFERENCE = "#/components/schemas/{model}"
WEBHOOK_HEADERS = {
    "webhook-id": "the event's id, the same at every try: whoever knows it already has this webhook",
    "webhook-timestamp": "when this try was sent, UNIX s",
    "webhook-signature": "v1, and HMAC-SHA256 of `id.timestamp.body` under the tenant's secret, in base64; several, "
    "with spaces between them, while the secret is changed",
}
WEBHOOKS = {
    "jobEnded": {
        "post": {
            "operationId": "job_ended",
            "summary": "A job has ended",
            "description": "Sent to a job's callback_url whenever the job has ended, until it is answered with 2xx or "
            "410. Headers and signature are those of Standard Webhooks.",
            "parameters": [
                {"name": name, "in": "header", "required": True, "schema": {"type": "string"}, "description": about}
                for name, about in WEBHOOK_HEADERS.items()
            ],
            "requestBody": {
                "required": True,
                "content": {"application/json": {"schema": {"$ref": REFERENCE.format(model=JobEnded.__name__)}}},
            },
            "responses": {"2XX": {"description": "the webhook has come"}},
            "security": [],
        }
    }
}
"""The webhooks that the service sends."""
KEY_SCHEME = {
    "type": "http",
    "scheme": "bearer",
    "description": "a key of `intrasplat keys create`; not needed on the machine itself",
}


class ProblemDocument(BaseModel):
    """Every answer that is not what was asked for (RFC 9457)."""

    model_config = ConfigDict(extra="allow", title="Problem")

    type: str = Field(description="about:blank: the status says what kind of problem it is")
    title: str
    status: int = Field(ge=400, le=599)
    detail: str = Field(description="what is wrong, with the value at fault")
    field: str | None = Field(default=None, description="the part of the request at fault; absent if there is none")
    remedy: str | None = Field(default=None, description="what to do about it")
    job_id: str | None = Field(default=None, description="the job that stands for the clip all the same")


class DescribedApp(FastAPI):
    """The service's FastAPI, whose OpenAPI document describes errors and keys correctly."""

    _document: ClassVar[dict[str, Any] | None] = None

    def openapi(self) -> dict[str, Any]:
        """The OpenAPI document, built once a process: every app of create_app has the same routes."""
        if DescribedApp._document is None:
            DescribedApp._document = _completed(super().openapi())
        return DescribedApp._document


def _completed(document: dict[str, Any]) -> dict[str, Any]:
    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    for name in ("HTTPValidationError", "ValidationError"):  # FastAPI's own, which this service never sends
        schemas.pop(name, None)
    schemas["Problem"] = ProblemDocument.model_json_schema()
    schemas |= BODIES
    schemas |= models_json_schema([(JobEnded, "serialization")], ref_template=REFERENCE)[1]["$defs"]
    document["webhooks"] = WEBHOOKS
    for name, example in EXAMPLES.items():
        if name in schemas:
            schemas[name]["examples"] = [example]
    components["securitySchemes"] = {"key": KEY_SCHEME}
    document["security"] = [{"key": []}, {}]
    for operation in _operations(document):
        responses = operation["responses"]
        responses.pop("422", None)
        responses["default"] = {
            "description": "a problem",
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
    return document


def _operations(document: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for path in document["paths"].values():
        yield from path.values()
