"""Client: one method a route, typed answers, errors as exceptions (client/errors.py)."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import httpx

from client.errors import JobCancelled, JobFailed, JobRejected, RequestRefused, ServiceFault
from contract.errors import InputError, UnavailableError
from contract.job import TERMINAL_STATES, JobState, JobView, parse_options

if TYPE_CHECKING:
    from numpy.typing import NDArray

DEFAULT_URL = "http://127.0.0.1:8765"
POLL_S = 0.5
CONNECT_TIMEOUT_S = 5.0
ANSWER_TIMEOUT_S = 60.0
UNAVAILABLE_REMEDY = "Start one with `intrasplat up`, or correct the address."


@dataclass(frozen=True)
class Image:
    """An answered render: the encoded file, and what it shows."""

    content: bytes
    media_type: str
    scene: str
    t: float
    warning: str | None

    def array(self) -> NDArray[Any]:
        """The values of a render asked for with format="npy"; needs numpy."""
        if self.media_type != "application/x-npy":
            raise InputError("format", f"this render is {self.media_type}.", 'Ask for it with format="npy".')
        import numpy as np  # here, so that a client without numpy can do everything else

        values: NDArray[Any] = np.load(io.BytesIO(self.content), allow_pickle=False)
        return values


class Client:
    """A connection to one service. Use it as a context, or call close()."""

    def __init__(self, url: str = DEFAULT_URL, *, transport: httpx.BaseTransport | None = None) -> None:
        timeout = httpx.Timeout(ANSWER_TIMEOUT_S, connect=CONNECT_TIMEOUT_S)
        self.url = url.rstrip("/")
        self._http = httpx.Client(base_url=self.url, timeout=timeout, transport=transport)

    def reconstruct(
        self,
        clip: Path,
        right: Path | None = None,
        *,
        calibration: Path | None = None,
        masks: Path | None = None,
        **options: Any,
    ) -> JobView:
        """Upload a clip (`right`: the right eye's file, if there are two) and get its queued job.

        `options` are the fields of JobOptions: preset, budget_s or iterations, mask_polarity, layout,
        pose_convention, holdout, seed.
        """
        document = parse_options(options).model_dump_json(exclude_unset=True)
        paths = {"clip": clip} if right is None else {"left": clip, "right": right}
        paths |= {name: path for name, path in (("calibration", calibration), ("masks", masks)) if path is not None}
        with contextlib.ExitStack() as stack:
            files = {part: (path.name, stack.enter_context(_opened(part, path))) for part, path in paths.items()}
            # An upload may take as long as it takes; only silence is a failure.
            response = self._request("POST", "/reconstruct", files=files, data={"options": document})
        return JobView.model_validate(response.json())

    def job(self, job_id: str) -> JobView:
        """Where a job stands."""
        return JobView.model_validate(self._request("GET", f"/jobs/{job_id}").json())

    def jobs(self) -> list[JobView]:
        """The newest jobs, newest first."""
        return [JobView.model_validate(job) for job in self._request("GET", "/jobs").json()]

    def cancel(self, job_id: str) -> JobView:
        """Cancel a job; a running one stops a moment later."""
        return JobView.model_validate(self._request("DELETE", f"/jobs/{job_id}").json())

    def watch(self, job_id: str, poll_s: float = POLL_S) -> Iterator[JobView]:
        """The job's view again and again, the last time in its terminal state."""
        while True:
            job = self.job(job_id)
            yield job
            if job.state in TERMINAL_STATES:
                return
            time.sleep(poll_s)

    def wait(self, job_id: str, on_progress: Callable[[JobView], object] | None = None) -> JobView:
        """The job, once it is done.

        Raises:
            JobRejected, JobFailed, JobCancelled: it did not come to a scene.
        """
        for job in self.watch(job_id):
            if on_progress is not None:
                on_progress(job)
        if job.state is JobState.CANCELLED:
            raise JobCancelled(job)
        if job.state is JobState.FAILED:
            if job.error is not None and job.error.field is not None:
                raise JobRejected(job, job.error.field, job.error.problem, job.error.remedy or "")
            raise JobFailed(job)
        return job

    def render(
        self,
        t: float = 0.0,
        *,
        scene: str | None = None,
        pose: str | None = None,
        layer: str = "rgb",
        format: str = "png",
        **camera: float,
    ) -> Image:
        """One view. `pose` as the API spells it; `camera` may hold width, height, fx, fy, cx, cy."""
        query: dict[str, Any] = {"t": t, "scene": scene, "pose": pose, "layer": layer, "format": format, **camera}
        given = {name: value for name, value in query.items() if value is not None}
        response = self._request("GET", "/render", params=given)
        return Image(
            content=response.content,
            media_type=response.headers["content-type"],
            scene=response.headers["x-intrasplat-scene"],
            t=float(response.headers["x-intrasplat-t"]),
            warning=response.headers.get("x-intrasplat-warning"),
        )

    def scenes(self) -> list[dict[str, Any]]:
        """All finished scenes, newest first."""
        scenes: list[dict[str, Any]] = self._request("GET", "/scenes").json()
        return scenes

    def report(self, scene: str) -> dict[str, Any]:
        """The scene's quality report."""
        report: dict[str, Any] = self._request("GET", f"/scenes/{scene}").json()
        return report

    def curve(self, scene: str) -> str:
        """Held-out psnr_tissue over seconds of training, as CSV."""
        return self._request("GET", f"/scenes/{scene}/curve").text

    def export(self, scene: str, t: float = 0.0, format: str = "ply") -> bytes:
        """The scene's Gaussians at time t as a file."""
        return self._request("GET", f"/scenes/{scene}/export", params={"t": t, "format": format}).content

    def delete(self, scene: str) -> None:
        """Remove clip, scene and record of a job that has ended."""
        self._request("DELETE", f"/scenes/{scene}")

    def info(self) -> dict[str, Any]:
        """Version, limits and accepted formats of the service."""
        info: dict[str, Any] = self._request("GET", "/info").json()
        return info

    def is_ready(self) -> bool:
        """Whether a clip sent now would be trained; False too while nobody answers."""
        try:
            return self._http.get("/readyz").status_code == httpx.codes.OK
        except httpx.TransportError:
            return False

    def close(self) -> None:
        """Let go of the connection."""
        self._http.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _request(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        try:
            response = self._http.request(method, path, **arguments)
        except (httpx.TransportError, httpx.InvalidURL) as error:
            problem = f"No service answers at {self.url} ({type(error).__name__})."
            raise UnavailableError(problem, UNAVAILABLE_REMEDY) from error
        if response.is_success:
            return response
        raise _error_of(response)


def _opened(part: str, path: Path) -> io.BufferedReader:
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(part, f"{path} cannot be read ({error.strerror}).", "Name a file that exists.") from error


def _error_of(response: httpx.Response) -> Exception:
    """The exception that a problem document means."""
    try:
        problem = response.json()
        detail, remedy = str(problem["detail"]), str(problem.get("remedy") or "")
    except (ValueError, KeyError, TypeError, AttributeError):
        return ServiceFault(f"The service answered {response.status_code} without saying why.")
    if response.status_code == httpx.codes.SERVICE_UNAVAILABLE:
        return UnavailableError(detail, remedy)
    if response.is_server_error and response.status_code != httpx.codes.INSUFFICIENT_STORAGE:
        return ServiceFault(detail)
    return RequestRefused(response.status_code, str(problem.get("field") or "request"), detail, remedy)
