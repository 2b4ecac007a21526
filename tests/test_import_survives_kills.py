"""kill -9 at every step of an import: what was acknowledged becomes one scene, and nothing else is left."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import httpx
import pytest

from intrasplat.names import SCENE
from tests.archives import archived, files_of, small_scene
from tests.chaos.deployment import Deployment, Victim
from tests.chaos.points import Point
from tests.chaos.worker_process import REAL_CHILD
from tests.test_many_machines import free_port

PATIENCE_S = 120.0


def eventually(holds: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        with suppress(httpx.HTTPError, KeyError, ValueError):  # it has just been killed
            if holds():
                return
        assert time.monotonic() < deadline_s
        time.sleep(0.1)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Deployment]:
    with Deployment(tmp_path_factory.mktemp("kills") / "site", free_port(), **{REAL_CHILD: "1"}) as site:
        yield site


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return archived(tmp_path_factory.mktemp("there") / "scene", small_scene())


def sent(site: Deployment, archive: bytes, answers: list[httpx.Response], key: dict[str, str]) -> None:
    with suppress(httpx.HTTPError):  # its service was killed
        answers.append(httpx.post(f"{site.url}/scenes", files={"scene": ("a.zip", archive)}, headers=key, timeout=60))


@pytest.mark.parametrize(
    ("point", "victim"),
    [
        (Point.SPOOLED, Victim.SERVICE),
        (Point.ENQUEUED, Victim.ALL),
        (Point.CLAIMED, Victim.SUPERVISOR),
        (Point.PUBLISHING, Victim.CHILD),
        (Point.PUBLISHING, Victim.SUPERVISOR),
        (Point.PUBLISHED, Victim.ALL),
    ],
)
def test_a_killed_import_becomes_one_scene(site: Deployment, archive: bytes, point: Point, victim: Victim) -> None:
    key = {"Idempotency-Key": f"{point} {victim}"}
    site.wait_until_ready()
    site.points.arm(point)
    answers: list[httpx.Response] = []
    sender = threading.Thread(target=sent, args=(site, archive, answers, key))
    sender.start()
    site.points.wait_for(point, PATIENCE_S)
    site.kill(victim)
    site.points.let_go()
    sender.join()
    site.points.reset()
    site.wait_until_ready()
    if not answers:  # nobody was told that it was taken, so it is sent again
        eventually(lambda: not sent(site, archive, answers, key) and bool(answers))
    assert answers[0].status_code == 202, answers[0].text
    job_id = answers[0].json()["id"]
    eventually(lambda: httpx.get(f"{site.url}/jobs/{job_id}").json()["state"] == "done")
    eventually(lambda: httpx.get(f"{site.url}/scenes/{job_id}").json()["scored"])
    eventually(lambda: len(httpx.get(f"{site.url}/jobs").json()) == 1)
    assert len(site.store.spooled_ids()) == 1
    (attempt,) = site.store.scene_attempts(job_id)
    assert (site.store.scene_folder(job_id, attempt) / SCENE).read_bytes() == files_of(archive)[SCENE]
    eventually(lambda: httpx.delete(f"{site.url}/scenes/{job_id}").json()["verified"])
    left = [path for area in ("spool", "scenes", "kept") for path in (site.data_dir / area).iterdir()]
    assert left == []
