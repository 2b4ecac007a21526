"""What can be asked of a service, each as a procedure (client/steps.py): a method here is one of both clients."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from client import submission, views, watching
from client.steps import Call, Steps, answered
from contract.wire.job import JobState, JobView


@dataclass(frozen=True)
class Calls:
    """patience_s: how long, in all, to wait where the service is busy or the connection is lost."""

    patience_s: float

    def reconstruct(self, prepared: submission.Submission) -> Steps[JobView]:
        """Send a clip."""
        return submission.reconstruct(prepared, self.patience_s)

    def watch(self, job_id: str) -> Steps[None]:
        """Follow a job."""
        return watching.watch(quote(job_id, safe=""), self.patience_s)

    def render(self, query: Mapping[str, Any], known: views.Image | None) -> Steps[views.Image]:
        """One view."""
        return views.render(query, known, self.patience_s)

    def job(self, job_id: str) -> Steps[JobView]:
        """Where a job stands."""
        return JobView.model_validate_json((yield from self._get("jobs", job_id)))

    def jobs(self, state: JobState | None, limit: int | None) -> Steps[list[JobView]]:
        """The newest jobs."""
        query = {"state": None if state is None else JobState(state).value, "limit": limit}
        return [JobView.model_validate(job) for job in json.loads((yield from self._get("jobs", query=query)))]

    def cancel(self, job_id: str) -> Steps[JobView]:
        """Cancel a job."""
        call = Call("DELETE", _path("jobs", job_id), is_repeatable=True)
        return JobView.model_validate_json((yield from self._sent(call)))

    def retry(self, job_id: str) -> Steps[JobView]:
        """Queue a failed job again."""
        return JobView.model_validate_json((yield from self._sent(Call("POST", _path("jobs", job_id, "retry")))))

    def scenes(self, limit: int | None) -> Steps[list[dict[str, Any]]]:
        """Finished scenes."""
        scenes: list[dict[str, Any]] = json.loads((yield from self._get("scenes", query={"limit": limit})))
        return scenes

    def report(self, scene: str) -> Steps[dict[str, Any]]:
        """A scene's report."""
        report: dict[str, Any] = json.loads((yield from self._get("scenes", scene)))
        return report

    def curve(self, scene: str) -> Steps[str]:
        """A scene's curve."""
        return (yield from self._get("scenes", scene, "curve")).decode()

    def export(self, scene: str, t: float, format: str) -> Steps[bytes]:
        """A scene's Gaussians."""
        return (yield from self._get("scenes", scene, "export", query={"t": t, "format": format}))

    def delete(self, scene: str) -> Steps[dict[str, Any]]:
        """Purge; not repeated when its answer is lost, since the second would be that there is no such scene."""
        receipt: dict[str, Any] = json.loads((yield from self._sent(Call("DELETE", _path("scenes", scene)))))
        return receipt

    def info(self) -> Steps[dict[str, Any]]:
        """What the service is."""
        info: dict[str, Any] = json.loads((yield from self._get("info")))
        return info

    def _get(self, *path: str, query: Mapping[str, Any] | None = None) -> Steps[bytes]:
        given = {name: value for name, value in (query or {}).items() if value is not None}
        return (yield from self._sent(Call("GET", _path(*path), given, is_repeatable=True)))

    def _sent(self, call: Call) -> Steps[bytes]:
        return (yield from answered(call, self.patience_s)).content


def _path(*parts: str) -> str:
    return "".join(f"/{quote(part, safe='')}" for part in parts)
