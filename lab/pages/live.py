"""The parts of docs/results/index.md on live feeds: the rows of bm_live.py and bm_feed_kills.py."""

from __future__ import annotations

from pathlib import Path
from statistics import median

from lab.evaluate.rows import read_rows
from lab.pages.markdown import number, origin, source, table

LIVE, KILLS = "live.csv", "feed_kills.csv"
_INTRODUCTION = """
## Live feeds

A clip is played to and fro in real time over MPEG-TS on loopback, and followed; somebody looks five times a second.
Age: from the arrival of the newest frame that the model knows to the rendered picture. Of several feeds at once the
fewest used frames and the oldest ages; cores, memory and disk are of all of them
([definitions](../../lab/benchmarks/bm_live.py)).
"""
_KILLED = """
### A process is killed

kill -9 at random moments while a whole installation follows a feed. Back: seconds until a view of a later moment is
shown over HTTP. Lost: seconds of what was known before. The cut before each kill must still be a whole clip.
"""
_COLUMNS = {
    "received_fps": ("received a second", 1), "used_fps": ("used a second", 1), "steps": ("steps each", 0),
    "first_s": ("first picture, s", 1), "age_p50_s": ("age p50, s", 2), "age_p95_s": ("p95", 2),
    "age_early_s": ("first third", 2), "age_late_s": ("last third", 2), "cores": ("cores", 1),
}  # fmt: skip


def live_sections(folder: Path) -> list[str]:
    """The sections whose rows exist."""
    return [*_followed(folder), *_killed(folder)]


def _killed(folder: Path) -> list[str]:
    rows = read_rows(folder / KILLS)
    if not rows:
        return []
    cells = []
    for who in dict.fromkeys(row["who"] for row in rows):
        here = [row for row in rows if row["who"] == who]
        back_s, lost_s = ([float(row[name]) for row in here] for name in ("back_s", "lost_s"))
        whole = sum(row["cut"] == "whole" for row in here)
        seconds = (median(back_s), max(back_s), max(lost_s))
        cells.append([who, str(len(here)), *(number(each, 1) for each in seconds), f"{whole} of {len(here)}"])
    header = ["killed", "kills", "back, s", "at most", "lost at most, s", "cuts whole"]
    command = source(f"python -m lab.benchmarks.bm_feed_kills --out lab/rows/{KILLS}", KILLS)
    return [_KILLED, command, table(header, cells), origin(rows)]


def _followed(folder: Path) -> list[str]:
    rows = read_rows(folder / LIVE)
    if not rows:
        return []
    header = ["clip", "pictures", "minutes", "feeds", *(name for name, _ in _COLUMNS.values())]
    cells = [
        [
            row["clip"],
            f"{row['width']}x{row['height']}",
            number(float(row["seconds"]) / 60, 1),
            row["feeds"],
            *(number(float(row[name]), digits) for name, (_, digits) in _COLUMNS.items()),
            number((float(row["rss_mib"]) + float(row["child_mib"])) / 1024, 1),
            number(60 * float(row["disk_mb"]) / float(row["past_s"]), 0),
        ]
        for row in rows
    ]
    command = source(f"python -m lab.benchmarks.bm_live --width 320 --out lab/rows/{LIVE}", LIVE)
    return [_INTRODUCTION, command, table([*header, "memory, GiB", "disk, MB a minute"], cells), origin(rows)]
