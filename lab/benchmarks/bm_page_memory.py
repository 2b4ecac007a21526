"""Does the page stay as small as it is while it plays a scene?

    python -m lab.benchmarks.bm_page_memory SCENE [--minutes 30] [--every-s 30] [--way always] [--out memory.csv]

A service with the scene of this folder, and its page in headless Chromium, which plays in a loop and turns now and
then. Every so many seconds a row: the JavaScript heap after a collection, nodes and listeners of the document, and
pictures shown so far. `--way always` lets the browser draw (on the processor here, so few pictures a second), `never`
leaves it to the service. The first line says who draws where
nobody has chosen, and how soon that was settled. The last line is the slope of the second half in kB of heap a minute.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from contract.store.store import Store
from intrasplat.scene.checkpoint import load_scene
from tests.client.page import Site, site_at
from tests.client.player import drawing_browser
from tests.client.test_player_in_browser import VIEWER, Drawn, opened
from worker.views import Views

COUNT = VIEWER % 'window.drawn = 0; viewer.addEventListener("shown", () => (window.drawn += 1)); done()'
LOOK_AT_GRAPHICS = """
const done = arguments[0];
import("/player/support.js").then(({ graphics }) => done(graphics().tookMs));
"""
TURN = VIEWER % "viewer.look({ pose: arguments[0] }); done()"
SWING_DEG = 10.0
FIELDS = ("minute", "heap_kb", "nodes", "listeners", "pictures")


def main() -> None:
    """Print a row every so often, and the slope."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every-s", type=float, default=30.0)
    parser.add_argument("--way", choices=("always", "never"), default="always")
    parser.add_argument("--out", type=Path, help="a CSV file of the rows")
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        data = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        site = stack.enter_context(site_at(data, Views(Store(data)).answer))
        driver = stack.enter_context(drawing_browser())
        driver.set_window_size(640, 480)
        page = stack.enter_context(opened(site.url, driver))
        page.press(site.scene(model=load_scene(options.scene)), "View")
        choice, took_ms = page.way, driver.execute_async_script(LOOK_AT_GRAPHICS)
        print(f"by itself: {' '.join(choice)}, {page.decided_ms:.1f} ms after the scene was chosen", end="; ")
        print(f"looking at the graphics took {took_ms:.1f} ms when the page was opened")
        page.choose_way(options.way)
        page.until_way(*(("memory", "") if options.way == "always" else ("service", "never")))
        rows = []
        writer = csv.DictWriter(sys.stdout, FIELDS)
        writer.writeheader()
        for row in played(site, page, options.minutes, options.every_s):
            rows.append(row)
            writer.writerow(row)
            sys.stdout.flush()
        if options.out:
            with options.out.open("w", newline="") as file:
                saved = csv.DictWriter(file, FIELDS)
                saved.writeheader()
                saved.writerows(rows)
        half = rows[len(rows) // 2 :]
        if len(half) > 1:
            slope = np.polyfit([row["minute"] for row in half], [row["heap_kb"] for row in half], 1)[0]
            print(f"the second half: {slope:+.1f} kB of heap a minute")


def played(site: Site, page: Drawn, minutes: float, every_s: float) -> Iterator[dict[str, float]]:
    """A row every so many seconds of play."""
    driver = page.driver
    driver.execute_cdp_cmd("HeapProfiler.enable", {})
    driver.execute_cdp_cmd("Performance.enable", {})
    driver.execute_async_script(COUNT)
    page.click("#play")
    began, number = time.monotonic(), 0
    while time.monotonic() - began < 60 * minutes:
        until = time.monotonic() + every_s
        while time.monotonic() < until:
            site.announce()  # else the worker counts as gone
            number += 1
            driver.execute_async_script(TURN, f"orbit:{SWING_DEG * np.sin(number):.2f},0,1")
            time.sleep(min(2.0, every_s))
        driver.execute_cdp_cmd("HeapProfiler.collectGarbage", {})
        found = {
            each["name"]: each["value"] for each in driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
        }
        yield {
            "minute": round((time.monotonic() - began) / 60, 2),
            "heap_kb": round(found["JSHeapUsedSize"] / 1000),
            "nodes": found["Nodes"],
            "listeners": found["JSEventListeners"],
            "pictures": page.script("return window.drawn"),
        }


if __name__ == "__main__":
    main()
