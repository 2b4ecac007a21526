"""Many renders at once, large ones, callers that leave: who waits, who is refused, who is not rendered for."""

from __future__ import annotations

import threading
import time
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from contract.queue.embedded import short_socket_path
from contract.wire.rendering import ExportRequest, RenderRequest, WorkerAddress
from tests.answers import at_once
from tests.service.live import live_service
from tests.service.under_test import ServiceUnderTest, assert_problem
from worker.daemon.pace import MAX_SAVED_S, SHARE, Pace
from worker.daemon.reply import Reply
from worker.daemon.serve import RequestServer


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_an_image_tag_of_a_page_from_elsewhere_is_refused_and_a_link_is_not(
    service: ServiceUnderTest, site: str
) -> None:
    query = {"scene": service.finished_scene()}
    image = {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "image"}
    assert_problem(service.http.get("/render", params=query, headers=image), 403, "Sec-Fetch-Site")
    for headers in ({"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "document"}, image | {"Sec-Fetch-Site": "same-origin"}):
        assert service.http.get("/render", params=query, headers=headers).status_code == 200


def test_a_worker_with_no_time_left_says_when_to_come_back_and_another_is_asked(service: ServiceUnderTest) -> None:
    scene, pace = service.finished_scene(), Pace()
    endpoint = f"ipc://{short_socket_path(service.store.run_dir, 'busy.sock')}"
    with RequestServer(endpoint, at_once(service.painter.answer, pace, max_wait_s=1.0)), pace.training():
        pace.charge(MAX_SAVED_S + 5.0 * SHARE)
        busy = WorkerAddress(name="busy", endpoint=endpoint, device="cpu", scenes=(scene,))
        service.queue.announce(busy)
        assert service.http.get("/render", params={"scene": scene}).status_code == 200
        service.queue.withdraw("worker-1")
        job_id = service.running_job()
        response = service.http.get("/render", params={"scene": job_id})
    assert 3.0 < assert_problem(response, 503)["retry_after_s"] <= 5.0
    assert response.headers["retry-after"] in ("4", "5")


def test_one_caller_holds_few_large_renders_at_a_time_and_its_small_ones_are_made(tmp_path: Path) -> None:
    with live_service(tmp_path, painter := HeldPainter()) as service, ThreadPoolExecutor() as pool:
        scene = service.finished_scene()

        def ask(width: int) -> httpx.Response:
            query = {"scene": scene, "width": str(width), "height": str(width // 2)}
            return httpx.get(f"{service.url}/render", params=query, timeout=10)

        large = [pool.submit(ask, 4096) for _ in range(4)]
        refused = [each.result() for each in futures.wait(large, timeout=5).done]
        assert [each.status_code for each in refused] == [429] * 2
        assert refused[0].json()["retry_after_s"] >= 1
        small = pool.submit(ask, 64)
        painter.go_on.set()
        assert small.result().status_code == 200
        assert sorted(each.result().status_code for each in large) == [200, 200, 429, 429]
        assert ask(4096).status_code == 200


def test_a_render_whose_caller_has_gone_is_not_made(tmp_path: Path) -> None:
    with live_service(tmp_path, painter := HeldPainter()) as service, ThreadPoolExecutor() as pool:
        scene = service.finished_scene()

        def ask(t: str, timeout_s: float) -> httpx.Response:
            return httpx.get(f"{service.url}/render", params={"scene": scene, "t": t}, timeout=timeout_s)

        first = pool.submit(ask, "0.1", 30)
        assert painter.began.wait(30)
        for t in ("0.2", "0.3"):
            with pytest.raises(httpx.ReadTimeout):
                ask(t, 0.5)
        time.sleep(0.2)  # the service notices
        painter.go_on.set()
        assert first.result().status_code == ask("0.4", 30).status_code == 200
    assert painter.asked == [0.1, 0.4]


class HeldPainter:
    """A worker that answers when it is let go, and notes the times it was asked for."""

    def __init__(self) -> None:
        self.asked: list[float] = []
        self.began, self.go_on = threading.Event(), threading.Event()

    def __call__(self, request: RenderRequest | ExportRequest) -> Reply:
        self.asked.append(request.t)
        self.began.set()
        assert self.go_on.wait(10)
        return Reply(b"picture", "image/png", request.t, gaussians=50_000, clip_size=(640, 512))
