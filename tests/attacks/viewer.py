"""The other tenant: asks for one view of 320x256 after the other and prints when, for how long, and the answer.

A process of its own, so that the attacker's threads do not slow its clock: `python -m tests.attacks.viewer URL SCENE`,
the key in INTRASPLAT_API_KEY. A line a view: UNIX s at which it was asked for, ms, status (0: no answer).
"""

from __future__ import annotations

import os
import random
import sys
import time

import httpx

PAUSE_S = 0.01


def main() -> None:
    """Ask until killed."""
    url, scene = sys.argv[1:]
    headers = {"Authorization": f"Bearer {os.environ['INTRASPLAT_API_KEY']}"}
    with httpx.Client(base_url=url, headers=headers, timeout=60) as http:
        while True:
            pose = f"orbit:{random.uniform(-15, 15):.2f},{random.uniform(-15, 15):.2f},1"
            query = {"scene": scene, "t": f"{random.random():.3f}", "pose": pose}
            asked_s, start_s = time.time(), time.perf_counter()
            try:
                size = {"width": "320", "height": "256", "format": "jpeg"}
                status = http.get("/render", params=query | size).status_code
            except httpx.HTTPError:
                status = 0
            print(f"{asked_s:.4f} {1e3 * (time.perf_counter() - start_s):.2f} {status}", flush=True)
            time.sleep(PAUSE_S)


if __name__ == "__main__":
    main()
