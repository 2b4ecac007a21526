"""`make chaos`: kill every process at every point of a clip's way, many times, and check what became of every clip.

python -m tests.chaos --kills 310 --deployments 6 --out lab/rows/chaos.md
"""

from __future__ import annotations

import argparse
import itertools
import platform
import random
import statistics
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from contract.queue.interface import BEAT_PERIOD_S, LEASE_S
from lab.evaluate.rows import commit, machine
from tests.chaos.campaign import CELLS, NO_MATTER, Outcome, run_kill
from tests.chaos.deployment import TENANTS, Deployment, Victim
from tests.chaos.history import RERUN_WITHIN_S, ClipHistory, orphans
from tests.chaos.points import Point
from tests.chaos.scenarios import ScenarioResult, bad_wire, zombie

CANCEL_EVERY = 5
"""Every fifth kill at a point that a cancel can precede comes after one."""
CANCELLABLE = (Point.CLAIMED, Point.KEEPING, Point.TRAINING, Point.TRAINED, Point.PUBLISHING, Point.PUBLISHED)


def main(argv: list[str] | None = None) -> int:
    """Run the campaign, write the table; 1 if any law was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__)
    parser.add_argument("--kills", type=int, default=310)
    parser.add_argument("--deployments", type=int, default=6, help="installations killed side by side")
    parser.add_argument("--first-port", type=int, default=18_800)
    parser.add_argument("--seed", type=int, default=0, help="of the order of the kills")
    parser.add_argument("--out", type=Path, help="write the table here as well")
    options = parser.parse_args(argv)
    plan = _plan(options.kills, options.seed)
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="intrasplat-chaos-") as folder:
        outcomes, left, told = _run_deployments(plan, Path(folder), options.deployments, options.first_port)
        seconds = time.monotonic() - started_s
        findings = _run_scenarios(Path(folder), options.first_port)
    table = _table(outcomes, left, told, seconds, options) + _scenario_lines(findings)
    print(table)
    if options.out is not None:
        options.out.write_text(table)
    broken = any(result.violations for result in (*outcomes, *findings))
    return 1 if left or broken or _strange(outcomes, told) else 0


def _plan(kills: int, seed: int) -> list[tuple[Victim, Point, bool]]:
    """As many kills of each cell, in a random order."""
    cells = itertools.islice(itertools.cycle(CELLS), kills)
    plan = [
        (target, point, point in CANCELLABLE and number // len(CELLS) % CANCEL_EVERY == CANCEL_EVERY - 1)
        for number, (target, point) in enumerate(cells)
    ]
    random.Random(seed).shuffle(plan)
    return plan


def _run_deployments(
    plan: list[tuple[Victim, Point, bool]], folder: Path, deployments: int, first_port: int
) -> tuple[list[Outcome], list[Path], list[str]]:
    """What became of each clip; folders that belong to none; the jobs of all webhooks that came."""
    outcomes: list[Outcome] = []
    left: list[Path] = []
    told: list[str] = []
    remaining: Iterator[tuple[Victim, Point, bool]] = iter(plan)
    lock = threading.Lock()

    def live_in(number: int) -> None:
        with Deployment(folder / f"deployment-{number}", first_port + number) as deployment:
            known: set[str] = set()
            while True:
                with lock:
                    cell = next(remaining, None)
                if cell is None:
                    break
                outcome = _one(deployment, *cell)
                if outcome.history.job_id is not None:
                    known.add(outcome.history.job_id)
                with lock:
                    outcomes.append(outcome)
                    _report(outcome, len(outcomes), len(plan))
            with lock:
                left.extend(orphans(deployment.store, known))
                told.extend(webhook.document["data"]["job_id"] for webhook in deployment.receiver.all)

    with ThreadPoolExecutor(deployments) as threads:
        for life in [threads.submit(live_in, number) for number in range(deployments)]:
            life.result()  # raises what a deployment that does not start raises
    return outcomes, left, told


def _strange(outcomes: list[Outcome], told: list[str]) -> set[str]:
    """The jobs of webhooks that are none of the campaign's."""
    return set(told) - {outcome.history.job_id for outcome in outcomes if outcome.history.job_id is not None}


def _run_scenarios(folder: Path, port: int) -> list[ScenarioResult]:
    findings = [
        zombie(folder / f"zombie-{point.name}", port, point)
        for point in (Point.CLAIMED, Point.TRAINING, Point.PUBLISHING, Point.PUBLISHED)
    ]
    return [*findings, bad_wire(folder / "wire", port, seed=0)]


def _scenario_lines(findings: list[ScenarioResult]) -> str:
    lines = ["", "# Sleepers and bad wires", "", "| scenario | seen | broken laws |", "|---|---|---|"]
    lines += [f"| {found.name} | {found.seen} | {'; '.join(found.violations) or 'none'} |" for found in findings]
    return "\n".join(lines) + "\n"


def _one(deployment: Deployment, target: Victim, point: Point, cancels: bool) -> Outcome:
    try:
        return run_kill(deployment, target, point, cancels)
    except Exception as error:  # a deployment that does not come back is the gravest violation
        deployment.points.let_go()
        deployment.wait_until_ready()
        return Outcome(ClipHistory((target.value, point.value)), [f"{type(error).__name__}: {error}"])


def _report(outcome: Outcome, done: int, total: int) -> None:
    for violation in outcome.violations:
        print(f"BROKEN {outcome.history.cell} {outcome.history.job_id}: {violation}", file=sys.stderr, flush=True)
    if done % 10 == 0:
        print(f"{done} of {total}", file=sys.stderr, flush=True)


def _table(
    outcomes: list[Outcome], left: list[Path], told: list[str], seconds: float, options: argparse.Namespace
) -> str:
    by_cell: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        by_cell[outcome.history.cell].append(outcome)
    accepted = [outcome for outcome in outcomes if outcome.history.job_id is not None]
    cancelled = [outcome for outcome in outcomes if outcome.history.cancel_heard]
    broken = [violation for outcome in outcomes for violation in outcome.violations]
    lines = [
        "# kill -9, everywhere",
        "",
        f"Command: `python -m tests.chaos --kills {options.kills} --deployments {options.deployments} "
        f"--seed {options.seed}` "
        f"(`make chaos`), commit {commit()}, {machine()}, Python {platform.python_version()}, "
        f"{options.deployments} installations side by side, {seconds / 60:.1f} min. "
        "The trainer is a stand-in that takes half a second; service, queue, supervisor and store are the real ones.",
        "",
        f"- kills: {len(outcomes)}; clips that got 202: {len(accepted)}; cancels that were confirmed: {len(cancelled)}",
        f"- tenants: {len(TENANTS)}; webhooks that came: {len(told)}, about {len(set(told))} jobs; "
        f"about jobs that are not the campaign's: {len(_strange(outcomes, told))}",
        f"- broken laws: {len(broken)}; folders that belong to no job: {len(left)}",
        f"- the law for running again: within {RERUN_WITHIN_S:g} s (lease {LEASE_S:g} + beat {BEAT_PERIOD_S:g} + 2), "
        "plus the restart where Valkey or all died",
        "",
        "Each cell: kills / clips that ran again, and the longest time from the kill until they did (median).",
        "",
        "| killed | " + " | ".join(point.value for point in Point) + " |",
        "|---|" + "---|" * len(Point),
    ]
    for target in Victim:
        cells = [
            "no part in it" if (target, point) in NO_MATTER else _cell(by_cell[target.value, point.value])
            for point in Point
        ]
        lines.append(f"| {target.value} | " + " | ".join(cells) + " |")
    lines += ["", *(f"- BROKEN {violation}" for violation in sorted(set(broken)))]
    return "\n".join(lines).rstrip() + "\n"


def _cell(outcomes: list[Outcome]) -> str:
    again = [outcome.history.rerun_s for outcome in outcomes if outcome.history.rerun_s is not None]
    times = f", {max(again):.1f} s ({statistics.median(again):.1f})" if again else ""
    return f"{len(outcomes)} / {len(again)}{times}"


if __name__ == "__main__":
    sys.exit(main())
