"""`make attacks`: replay what stopped everybody once, and measure what the other tenant feels of it.

python -m tests.attacks --seconds 10 --rounds 3 --out lab/rows/attacks.md

Starts `intrasplat up` on a folder of its own, with two tenants. One attacks; the other asks for one view of 320x256 of
its own scene after the other. Its p99 during an attack is compared with that of the quiet seconds before and after.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from lab.benchmarks.bm_service import wait_for_stage
from lab.evaluate.rows import commit, machine
from tests.attacks.arena import Arena, View, p99_ms, standing
from tests.attacks.attacks import ATTACKS, Attack, Heard

MAX_RATIO = 2.0
SETTLE_S = 1.0


@dataclass(frozen=True)
class Row:
    """One attack: what it heard, and the other tenant's views without and with it."""

    attack: Attack
    heard: Heard
    quiet: list[View]
    during: list[View]

    @property
    def ratio(self) -> float:
        """Of the other tenant's p99 to its quiet value."""
        return p99_ms(self.during) / p99_ms(self.quiet)

    @property
    def refused(self) -> Counter[int]:
        """The other tenant's views that were not answered with a picture."""
        return Counter(view.status for view in self.during if view.status != 200)

    @property
    def holds(self) -> bool:
        """Whether the attack got no more than it may, and the other tenant went on."""
        is_slow = not self.attack.stops_views and (bool(self.refused) or not self.ratio <= MAX_RATIO)
        return self.heard.is_bounded and not is_slow


def main(argv: list[str] | None = None) -> int:
    """Run them all, print the table; 1 if one of them got through."""
    parser = argparse.ArgumentParser(prog="python -m tests.attacks", description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each attack, and of the quiet around it")
    parser.add_argument("--rounds", type=int, default=3, help="of quiet, attack and quiet; their views count together")
    parser.add_argument("--only", default="", help="attacks whose name holds this")
    parser.add_argument("--out", type=Path, help="write the table here as well")
    options = parser.parse_args(argv)
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="intrasplat-attacks-") as folder, standing(Path(folder)) as arena:
        rows = [
            _measured(arena, each, options.seconds, options.rounds) for each in ATTACKS if options.only in each.name
        ]
    table = _table(rows, (options.seconds, options.rounds), (load, os.getloadavg()[0]))
    print(table)
    if options.out is not None:
        options.out.write_text(table)
    return 0 if all(row.holds for row in rows) else 1


def _measured(arena: Arena, attack: Attack, seconds: float, rounds: int) -> Row:
    """Quiet and attack in turn, so that both see the machine's other load."""
    heard, quiet, during = list[Heard](), list[View](), list[View]()
    for _ in range(rounds):
        time.sleep(SETTLE_S)
        quiet += _quiet(arena, attack, seconds / 2)
        began_s = time.time()
        heard.append(attack.run(arena, seconds))
        during += arena.views(began_s, time.time())
        time.sleep(SETTLE_S)
        quiet += _quiet(arena, attack, seconds / 2)
    row = Row(attack, Heard.all_of(heard), quiet, during)
    print(_line(row), file=sys.stderr, flush=True)
    return row


def _quiet(arena: Arena, attack: Attack, seconds: float) -> list[View]:
    """The other tenant's views while nobody attacks; beside an honest job, if the attack is a job, too."""
    if not attack.trains:
        began_s = time.time()
        time.sleep(seconds)
        return arena.views(began_s, time.time())
    with arena.client as client:
        began_s = time.time()
        job = client.reconstruct(arena.clip.video, calibration=arena.clip.calibration, budget_s=60)
        wait_for_stage(client, job.id, "train")
        time.sleep(seconds)
        client.cancel(job.id)
    return arena.views(began_s, time.time())


def _table(rows: list[Row], length: tuple[float, int], load: tuple[float, float]) -> str:
    """length: seconds and rounds."""
    (seconds, rounds), held = length, sum(row.holds for row in rows)
    lines = [
        "# Attacks, replayed",
        "",
        f"Command: `python -m tests.attacks --seconds {seconds:g} --rounds {rounds}` (`make attacks`), "
        f"commit {commit()}, {machine()}, "
        f"Python {platform.python_version()}, load average {load[0]:.1f} at the start and {load[1]:.1f} at the end, of "
        f"niceness {os.nice(0)}. The numbers are rows of a review that found these attacks to stop everybody.",
        "",
        f"{held} of {len(rows)} hold: the attacker gets no more than it may, and the other tenant's p99 of a view of "
        f"320x256 stays within {MAX_RATIO:g} times its quiet value. {rounds} rounds count together, each of "
        f"{seconds:g} s of attack between twice {seconds / 2:g} s of quiet; where a job of the attack trains, quiet is "
        "beside an honest job of the same tenant. In brackets: views.",
        "",
        "| row | attack | answers | bounded | quiet p99, ms | p99, ms | ratio | |",
        "|---|---|---|---|---|---|---|---|",
        *(_line(row) for row in rows),
    ]
    return "\n".join(lines) + "\n"


def _line(row: Row) -> str:
    views = "| | | "
    if not row.attack.stops_views:
        times = (f"{p99_ms(each):.0f} ({len(each)})" for each in (row.quiet, row.during))
        refused = "".join(f", {count} x {status}" for status, count in sorted(row.refused.items()))
        views = f"| {' | '.join(times)} | {row.ratio:.2f}{refused} "
    bounded, holds = "yes" if row.heard.is_bounded else "**no**", "holds" if row.holds else "**fails**"
    return f"| {row.attack.row} | {row.attack.name} | {row.heard} | {bounded} {views}| {holds} |"


if __name__ == "__main__":
    sys.exit(main())
