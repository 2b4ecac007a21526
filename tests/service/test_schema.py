"""Whatever is sent to any operation: no fault of the service, and every refusal is the problem that is documented."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis import Case, CheckContext, GenerationMode, Response
from schemathesis.checks import CheckFunction, not_a_server_error
from schemathesis.schemas import BaseSchema
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from contract.wire.rendering import WorkerAddress
from tests.service.live import WORKER, LiveService, live_service
from tests.service.test_app import OPERATIONS

EXAMPLES = 24


def every_refusal_is_a_problem(context: CheckContext, response: Response, case: Case) -> None:
    """An answer of 400 or more is a problem document that carries the status."""
    if response.status_code >= 400 and case.method != "HEAD":
        assert response.headers["content-type"] == ["application/problem+json"]
        problem = response.json()
        assert problem["status"] == response.status_code
        assert problem["detail"]


schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")

CHECKS: list[CheckFunction] = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
    every_refusal_is_a_problem,
]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    limits = {"requests_per_s": 1e6, "max_upload_bytes": 100_000}  # not to be stopped by rate or room
    with live_service(tmp_path_factory.mktemp("data"), **limits) as running:
        yield running


@pytest.fixture
def scene(service: LiveService) -> str:
    return service.finished_scene()


@pytest.fixture(scope="module")
def api(service: LiveService) -> BaseSchema:
    schema = schemathesis.openapi.from_url(f"{service.url}/openapi.json")
    schema.config.generation.update(with_security_parameters=False)
    return schema


@pytest.fixture
def ready(service: LiveService) -> LiveService:
    service.queue.announce(WorkerAddress(name=WORKER, endpoint=service.worker_endpoint, device="cpu"))
    return service


QUICK = settings(
    max_examples=EXAMPLES,
    derandomize=True,
    deadline=None,
    database=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=list(HealthCheck),
)


@pytest.mark.parametrize("operation_id", sorted(OPERATIONS))
def test_whatever_is_sent_is_answered_as_documented(
    api: BaseSchema, ready: LiveService, scene: str, operation_id: str
) -> None:
    operation = api.find_operation_by_id(operation_id)
    allowed, forbidden = (operation.as_strategy(generation_mode=mode) for mode in GenerationMode)

    @QUICK
    @given(allowed | forbidden)
    def send(case: Case) -> None:
        case.call_and_validate(checks=CHECKS)
        for name in {"job_id", "scene_id"} & set(case.path_parameters or {}):  # once more, of what is there
            case.path_parameters[name] = scene
            case.call_and_validate(checks=CHECKS)

    send()
