"""What becomes of a live feed when a process of a whole installation is killed (kill -9), at random moments.

    python -m lab.benchmarks.bm_feed_kills [--who reader child supervisor service queue sender] [--times 20] [--seed 0]
        [--clip phantom:breathing:72frames:stereo] [--width 320] [--fps 30] [--out lab/rows/feed_kills.csv]

Starts `intrasplat up` on a data directory of its own, and a sender that plays a clip to and fro in real time over
MPEG-TS on loopback; whatever is killed is started again, the sender by this program, all else by the installation.
Before each kill the last seconds are cut, and the 202 is waited for. Measured are, for each kill: the seconds until a
view of a moment that came in later is shown over HTTP (`back_s`); the states of the feed until then; how many seconds
before the kill the newest moment lies that can be viewed of what was known (`lost_s`), by asking for its time; and
whether the job of the cut is known, and its clip holds the frames that the 202 named (`cut`).

A kill fails if it takes longer than BACK_S, or if the cut is not whole; then the exit status is 1.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from statistics import median

import av
import av.error
import httpx

from intrasplat_client import Client, CutJob, FeedState, IntrasplatError
from lab.benchmarks.bm_follow import played_of
from lab.benchmarks.bm_live import encode
from lab.benchmarks.send_stream import sending
from lab.demo import free_port, started_service
from lab.evaluate.rows import Row, adding_alone, commit, machine, replace_row, texts_of
from lab.evaluate.sources import DATA_VARIABLE, source_of

BACK_S = 6.0
CUT_S = 4.0
MAX_WAIT_S = 120.0
SETTLE_S = 6.0
"""At least so much is known before a kill, and passes after one."""
MOMENT_S = 3.0
"""A kill comes at a random moment of so many seconds."""
STEP_S = 0.1
"""Between two times at which it is looked for what is left of the past."""
LOST_MOST_S = 30.0
NAMES = {
    "reader": "-m intrasplat.live.child",
    "child": "-m worker feed",
    "supervisor": "-m worker consume",
    "service": "-m service",
    "queue": "-server unixsocket:",
}
"""What stands in the command line of each process of the installation."""
WHO = (*NAMES, "sender")
KEY = ("who", "number", "seed", "clip", "width", "fps")
FIELDS = (*KEY, "moment_s", "back_s", "states", "lost_s", "cut", "load", "machine", "commit")


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    os.environ.setdefault(DATA_VARIABLE, "../shared/data")
    plan = [(who, number) for who in options.who for number in range(options.times)]
    random.Random(options.seed).shuffle(plan)
    moments, rows = random.Random(options.seed), list[Row]()
    with tempfile.TemporaryDirectory(prefix="intrasplat-kills-") as name, adding_alone(options.out.parent):
        folder = Path(name)
        played = played_of(source_of(options.clip), options.fps)
        encode(played, folder / "clip.ts")
        (folder / "calibration.json").write_text(played.calibration.model_dump_json())
        with Sender(folder / "clip.ts", options.fps) as sender:
            os.environ |= {"INTRASPLAT_FEED_HOSTS": sender.url, "INTRASPLAT_FEED_PRIVATE": "yes"}
            log = folder / "up.log"
            with started_service(folder / "data", log) as client, shown_on_failure(log):
                bench = Bench(client, sender, folder / "data")
                bench.open(folder / "calibration.json", options.width)
                for who, number in plan:
                    row = {name: getattr(options, name) for name in ("seed", "clip", "width", "fps")}
                    row |= {"who": who, "number": number} | bench.killed(who, moments.uniform(0.0, MOMENT_S))
                    row |= {"load": os.getloadavg()[0], "machine": machine(), "commit": commit()}
                    rows.append(texts_of(row, FIELDS))
                    replace_row(options.out, FIELDS, KEY, rows[-1])
                    print("  ".join(f"{each} {rows[-1][each]}" for each in FIELDS[:-2]), flush=True)
    well = [_is_well(who, [row for row in rows if row["who"] == who]) for who in options.who]
    return 0 if all(well) else 1


def _is_well(who: str, rows: list[Row]) -> bool:
    """Print what became of one kind of kill. Whether all was as it must be."""
    back_s, lost_s = ([float(row[name]) for row in rows] for name in ("back_s", "lost_s"))
    whole = sum(row["cut"] == "whole" for row in rows)
    print(
        f"{who}: {len(rows)} kills; back after {median(back_s):.1f} s, at most {max(back_s):.1f} s; at most "
        f"{max(lost_s):.1f} s of the past lost; {whole} cuts whole"
    )
    return max(back_s) <= BACK_S and whole == len(rows)


class Sender:
    """Plays a stream on a port of its own, by a process that is started again whenever it ends. A context manager."""

    def __init__(self, stream: Path, fps: float) -> None:
        self._port = free_port()
        self.url = f"tcp://127.0.0.1:{self._port}"
        self._command = sending(stream, fps, self._port)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="sender")
        self.process_id: int | None = None

    def __enter__(self) -> Sender:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._end.set()
        self._thread.join()

    def _keep(self) -> None:
        while not self._end.is_set():
            with subprocess.Popen(self._command, stdout=subprocess.DEVNULL) as process:
                self.process_id = process.pid
                while process.poll() is None and not self._end.wait(0.02):
                    pass
                process.kill()


class Bench:
    """An installation with one feed."""

    def __init__(self, client: Client, sender: Sender, data_dir: Path) -> None:
        self._client, self._sender, self._data_dir = client, sender, data_dir
        self._http = httpx.Client(base_url=client.url, timeout=2.0)
        self._feed_id = ""

    def open(self, calibration: Path, width: int) -> None:
        """Open the feed, and wait until it is followed."""
        feed = self._client.open_feed(calibration, self._sender.url, layout="sbs", width=width)
        self._feed_id = feed.id
        self._until_live()

    def killed(self, who: str, moment_s: float) -> dict[str, object]:
        """Kill one process some time after a cut was acknowledged; what was measured."""
        self._until_live()
        job = self._client.cut_feed(self._feed_id, -CUT_S, iterations=20, preset="instant", poses="fixed")
        time.sleep(moment_s)
        known_at = self._client.feed(self._feed_id).ends_s or 0.0
        process_id = self._sender.process_id if who == "sender" else process_of(NAMES[who])
        assert process_id is not None, f"{who} does not run"
        killed_at = time.time()
        os.kill(process_id, signal.SIGKILL)
        states = list[str]()
        self._until(lambda: self._shows_after(killed_at, states))
        back_s = time.time() - killed_at
        self._until_live()
        lost_s = max(0.0, known_at - self._newest_before(known_at))
        found = {"moment_s": moment_s, "back_s": back_s, "states": " ".join(states), "lost_s": lost_s}
        return found | {"cut": self._cut(job)}

    def _shows_after(self, killed_at: float, states: list[str]) -> bool:
        """Whether a view of something newer is shown; adds the feed's state where it is another one."""
        shown = self._http.get("/render", params={"scene": self._feed_id, "t": "live", "format": "jpeg"})
        if shown.status_code != 200:
            shown = self._http.get(f"/feeds/{self._feed_id}")
            state = str(shown.json().get("state")) if shown.status_code == 200 else str(shown.status_code)
            is_newer = False
        else:
            state = shown.headers["x-intrasplat-state"]
            is_newer = datetime.fromisoformat(shown.headers["x-intrasplat-captured-at"]).timestamp() > killed_at
        if states[-1:] != [state]:
            states.append(state)
        return is_newer

    def _newest_before(self, known_at: float) -> float:
        """The newest moment up to a time, UNIX s, that can be viewed; LOST_MOST_S before it if none is found."""
        asked_at = known_at
        while asked_at > known_at - LOST_MOST_S:
            t = datetime.fromtimestamp(asked_at, UTC).isoformat()
            shown = self._http.get(f"/scenes/{self._feed_id}/recorded", params={"t": t, "masks": "off"})
            if shown.status_code == 200:
                at = datetime.fromisoformat(shown.headers["x-intrasplat-captured-at"]).timestamp()
                if at <= known_at + STEP_S / 2:
                    return min(at, known_at)
            asked_at -= STEP_S
        return known_at - LOST_MOST_S

    def _cut(self, job: CutJob) -> str:
        """What has become of an acknowledged cut; it is deleted."""
        known = self._client.job(job.id)
        clip = next((self._data_dir / "spool" / job.id).glob("clip.*"), None)
        if clip is None:
            result = "lost" if known.state != "done" else "whole"
        else:
            frames = frames_of(clip)
            result = "whole" if frames == job.cut.frames else f"{frames} of {job.cut.frames} frames"
        with suppress(IntrasplatError):
            self._client.cancel(job.id)
        return result

    def _until_live(self) -> None:
        """Wait until the feed is live, and enough of it is known for a cut."""

        def is_live() -> bool:
            feed = self._client.feed(self._feed_id)
            known_s = (feed.source_ends_s or 0.0) - (feed.source_begins_s or 0.0)
            return feed.state in (FeedState.LIVE, FeedState.BEHIND) and known_s > SETTLE_S

        self._until(is_live)
        time.sleep(SETTLE_S)

    def _until(self, holds: Callable[[], bool]) -> None:
        until_s = time.monotonic() + MAX_WAIT_S
        while time.monotonic() < until_s:
            with suppress(IntrasplatError, httpx.HTTPError):
                if holds():
                    return
            time.sleep(0.05)
        raise TimeoutError(f"It did not become live again within {MAX_WAIT_S:g} s.")


def process_of(name: str) -> int | None:
    """The process that this one has started, by others, whose command line has this in it (Linux)."""
    waiting = [os.getpid()]
    while waiting:
        process_id = waiting.pop(0)
        with suppress(OSError):
            if name in Path(f"/proc/{process_id}/cmdline").read_bytes().decode().replace("\0", " "):
                return process_id
            for task in Path(f"/proc/{process_id}/task").iterdir():
                waiting += map(int, (task / "children").read_text().split())
    return None


def frames_of(clip: Path) -> int:
    """How many frames of a clip can be decoded."""
    try:
        with av.open(str(clip)) as container:
            return sum(1 for _ in container.decode(video=0))
    except av.error.FFmpegError:
        return 0


@contextmanager
def shown_on_failure(log: Path) -> Iterator[None]:
    """Print the end of a log if the context fails."""
    try:
        yield
    except BaseException:
        print("\n".join(log.read_text().splitlines()[-60:]), file=sys.stderr)
        raise


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--who", nargs="+", choices=WHO, default=list(WHO))
    parser.add_argument("--times", type=int, default=20, help="kills of each")
    parser.add_argument("--seed", type=int, default=0, help="of the order and the moments")
    parser.add_argument("--clip", default="phantom:breathing:72frames:stereo")
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--out", type=Path, default=Path("lab/rows/feed_kills.csv"))
    return parser


if __name__ == "__main__":
    sys.exit(main())
