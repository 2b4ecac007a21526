"""Does the page's player show what a worker renders, and how soon after the download?

    python -m lab.benchmarks.bm_player SCENE [SCENE ...] [--views 12] [--scale 1.0] [--load-only]

For each scene's folder: the CPU seconds of decoding in four workers, which as many cores share, and the milliseconds of
decoding, packing and filling textures in headless Chromium, then views at
the endoscope's eyes, on orbits up to 20 degrees away and at random times: PSNR against intrasplat/view, the largest
difference, how many pixels differ by more than 24 levels, and the milliseconds of deforming, sorting and drawing.
Chromium draws on the processor here (SwiftShader); a GPU's milliseconds are on the page under details.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from intrasplat.scene.checkpoint import SCENE_FILE, load_scene
from tests.client.player import TIE_LEVELS, PlayerPage, Seen, drawing_browser, player_page

MAX_YAW_DEG, MAX_PITCH_DEG = 20.0, 12.0
LOADS = 3


def views(count: int) -> Iterator[Seen]:
    """Random views. The first is the endoscope's at the start, every fourth the right eye's, every second hatched."""
    random = np.random.default_rng(0)
    yield Seen()
    for number in range(1, count):
        t, yaw, pitch = random.uniform((0, -MAX_YAW_DEG, -MAX_PITCH_DEG), (1, MAX_YAW_DEG, MAX_PITCH_DEG))
        zoom, is_marked = random.uniform(0.8, 2.0), number % 2 == 0
        if number % 4 == 0:
            yield Seen(t, eye="right", is_marked=is_marked)
        else:
            yield Seen(t, orbit=(yaw, pitch, zoom), highlights=number % 4 != 3, is_marked=is_marked)


def main() -> None:
    """Print a block a scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--scale", type=float, default=1.0, help="of the clip's size")
    parser.add_argument("--load-only", action="store_true", help="draw nothing")
    options = parser.parse_args()
    with drawing_browser() as driver:
        for folder in options.scenes:
            with player_page(driver, folder) as page:
                _load(page, folder, driver.service.process.pid)
                if not options.load_only:
                    _draw(page, folder, options.views, options.scale)


def _load(page: PlayerPage, folder: Path, browser_pid: int) -> None:
    size = (folder / SCENE_FILE).stat().st_size
    print(f"{folder}: {size / 1e6:.2f} MB")
    for _ in range(LOADS):
        before_s = _cpu_s(browser_pid)
        page.decode()
        cpu_s, times = _cpu_s(browser_pid) - before_s, page.load()
        parts = ", ".join(f"{name} {times[name]:.0f}" for name in ("decodeMs", "packMs", "uploadMs"))
        print(f"  decoding {cpu_s:.2f} CPU s; {parts}", flush=True)


def _cpu_s(process_id: int) -> float:
    """CPU seconds of a process and all its descendants (Linux)."""
    try:
        fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
        tasks = list(Path(f"/proc/{process_id}/task").iterdir())
        children = [child for each in tasks for child in (each / "children").read_text().split()]
    except OSError:  # it has ended
        return 0.0
    own_s = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return own_s + sum(_cpu_s(int(child)) for child in children)


def _draw(page: PlayerPage, folder: Path, count: int, scale: float) -> None:
    scene = load_scene(folder)
    lowest_db, largest = np.inf, 0
    for seen in views(count):
        compared = page.compare(scene, seen, scale, is_timed=True)
        far = int((compared.levels > TIE_LEVELS).sum())
        parts = ", ".join(f"{name} {compared.times[name]:.0f}" for name in ("deformMs", "sortMs", "drawMs"))
        print(
            f"  {compared.psnr_db:6.2f} dB, most {compared.levels.max():3d}, {far} beyond; {parts}; {seen}", flush=True
        )
        lowest_db, largest = min(lowest_db, compared.psnr_db), max(largest, int(compared.levels.max()))
    print(f"  {count} views: {lowest_db:.2f} dB and {largest} levels at worst", flush=True)


if __name__ == "__main__":
    main()
