"""A whole installation with two tenants: one attacks, the other looks at its scene all the time."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from contract.access.keys import DEFAULT_SCOPES, KeyFile
from intrasplat_client import Client
from lab.benchmarks.bm_service import PhantomClip, make_clip, trained
from lab.demo import started_service

GIB = 2**30
ROOM_BYTES = 40 * GIB
"""What uploads may fill, so that the promises of an attack mean the same on every disk."""
ITERATIONS = 300
FIRST_VIEWS = 50
"""Not counted: the scene is loaded, and its last scores are made."""
PAUSE_S = 0.2
"""Of an attacker, who means to do harm by what a request costs: floods are bounded by INTRASPLAT_REQUESTS_PER_S."""


@dataclass(frozen=True)
class View:
    """One picture that the other tenant asked for; status 0: there was no answer."""

    asked_s: float
    ms: float
    status: int


@dataclass
class Arena:
    """The service, the attacker's key, scene and clip, and the file to which the other tenant's viewer writes."""

    url: str
    data_dir: Path
    headers: dict[str, str]
    scene: str
    clip: PhantomClip
    other: dict[str, str]
    _views: Path

    @property
    def client(self) -> Client:
        """The attacker's client."""
        return Client(self.url, api_key=self.headers["Authorization"].split()[1])

    def http(self, **changes: Any) -> httpx.Client:
        """The attacker's connection."""
        return httpx.Client(base_url=self.url, **({"headers": self.headers, "timeout": 60} | changes))

    def attack(self, work: Callable[[], str], seconds: float, at_once: int = 1) -> Counter[str]:
        """What comes of `work`, done again and again by so many at once, with a pause after each answer."""
        end_s = time.monotonic() + seconds

        def go_on() -> Counter[str]:
            heard: Counter[str] = Counter()
            while time.monotonic() < end_s:
                heard[work()] += 1
                time.sleep(PAUSE_S)
            return heard

        with ThreadPoolExecutor(at_once) as threads:
            return sum((each.result() for each in [threads.submit(go_on) for _ in range(at_once)]), Counter[str]())

    def views(self, since_s: float, until_s: float) -> list[View]:
        """What the other tenant asked for from then to then, UNIX s."""
        lines = (line.split() for line in self._views.read_text().splitlines() if line.count(" ") == 2)
        found = (View(float(asked), float(ms), int(status)) for asked, ms, status in lines)
        return [view for view in found if since_s <= view.asked_s < until_s]


def p99_ms(views: list[View]) -> float:
    """The time below which 99 % of these were answered."""
    return float(np.percentile([view.ms for view in views], 99)) if views else float("nan")


@contextmanager
def standing(folder: Path) -> Iterator[Arena]:
    """Start `intrasplat up` that asks for keys, train a scene for each of two tenants, and let one look at its own."""
    clip, data_dir = make_clip(folder, 320, 256, 24), folder / "data"
    data_dir.mkdir(mode=0o700)
    keys = [KeyFile(data_dir).create(tenant, DEFAULT_SCOPES)[1] for tenant in ("attacker", "other")]
    min_free_bytes = max(shutil.disk_usage(folder).free - ROOM_BYTES, 0)
    os.environ |= {"INTRASPLAT_HOSTS": "attacked.example", "INTRASPLAT_MIN_FREE_BYTES": str(min_free_bytes)}
    with started_service(data_dir, folder / "service.log") as client:
        scenes = []
        for key in keys:
            with Client(client.url, api_key=key) as tenant:
                scenes.append(trained(tenant, clip, iterations=ITERATIONS))
        views, environment = folder / "views", os.environ | {"INTRASPLAT_API_KEY": keys[1]}
        command = [sys.executable, "-m", "tests.attacks.viewer", client.url, scenes[1]]
        with views.open("wb") as lines:
            viewer = subprocess.Popen(command, env=environment, stdout=lines)
        try:
            attacker, other = ({"Authorization": f"Bearer {key}"} for key in keys)
            arena = Arena(client.url, data_dir, attacker, scenes[0], clip, other, views)
            while len(arena.views(0.0, time.time())) < FIRST_VIEWS:
                time.sleep(PAUSE_S)
            yield arena
        finally:
            viewer.kill()
            viewer.wait()
