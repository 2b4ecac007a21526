"""The attacks that once stopped everybody, one function each: what the attacker heard, and whether that is bounded."""

from __future__ import annotations

import base64
import json
import os
import random
import signal
import socket
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import httpx

from intrasplat.intake.limits import MAX_CALIBRATION_BYTES
from intrasplat_client import JobRejected
from lab.benchmarks.bm_service import process
from tests.attacks.arena import GIB, Arena
from tests.intrasplat.clip.hostile import CALIBRATION, VIDEO

LARGE = {"width": "4096", "height": "2160", "format": "jpeg"}
UPLOADS_OF_TENANT = 4
"""Half of INTRASPLAT_MAX_UPLOADS."""
DRIP_BYTES, DRIP_PERIOD_S = 7, 0.1
READY_WITHIN_S = 1.0
SCALE_CODES = ("calibration_scaled", "field_of_view_unusual")
"""Notices of a calibration that may be of another size."""
TUS = {"Tus-Resumable": "1.0.0"}


@dataclass(frozen=True)
class Heard:
    """What an attacker was answered, and whether it got no more than it may."""

    answers: Counter[str]
    is_bounded: bool
    note: str = ""

    @classmethod
    def all_of(cls, rounds: list[Heard]) -> Heard:
        """What was heard in all rounds."""
        answers = sum((each.answers for each in rounds), Counter[str]())
        notes = dict.fromkeys(each.note for each in rounds if each.note)
        return cls(answers, all(each.is_bounded for each in rounds), "; ".join(notes))

    def __str__(self) -> str:
        counts = ", ".join(f"{answer} x {count}" for answer, count in sorted(self.answers.items()))
        return "; ".join(each for each in (counts, self.note) if each)


@dataclass(frozen=True)
class Attack:
    """row: of the findings. trains: one of its jobs is trained, so that it is compared with an honest job's training.

    stops_views: nobody can be shown anything meanwhile.
    """

    row: int
    name: str
    run: Callable[[Arena, float], Heard]
    trains: bool = False
    stops_views: bool = False


def _only(answers: Counter[str], *allowed: str, note: str = "") -> Heard:
    return Heard(answers, bool(answers) and set(answers) <= set(allowed), note)


def _large(arena: Arena, http: httpx.Client) -> str:
    try:
        answer = http.get("/render", params={"scene": arena.scene, "t": f"{random.random():.3f}", **LARGE})
    except httpx.ReadTimeout:
        return "left"
    is_told = answer.status_code not in (429, 503) or "retry-after" in answer.headers
    return f"{answer.status_code}" if is_told else f"{answer.status_code} without Retry-After"


def large_renders(arena: Arena, seconds: float) -> Heard:
    """Six renders of 4096x2160 at once, again and again."""
    with arena.http() as http:
        return _only(arena.attack(lambda: _large(arena, http), seconds, at_once=6), "200", "429", "503")


def abandoned_renders(arena: Arena, seconds: float) -> Heard:
    """Four renders of 4096x2160 at once, each given up after a second."""
    with arena.http(timeout=1.0) as http:
        return _only(arena.attack(lambda: _large(arena, http), seconds, at_once=4), "200", "429", "503", "left")


def foreign_image(arena: Arena, seconds: float) -> Heard:
    """What the browser of somebody here sends for an image tag in a page from elsewhere."""
    headers = arena.headers | {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}
    with arena.http(headers=headers) as http:
        return _only(arena.attack(lambda: _large(arena, http), seconds, at_once=6), "403")


def queue_stopped(arena: Arena, seconds: float) -> Heard:
    """The queue's server takes connections and answers nothing; views of finished scenes go on."""
    server = process(lambda command, _: str(arena.data_dir / "valkey").encode() in command)
    os.kill(server, signal.SIGSTOP)
    try:
        with arena.http() as http:
            return _only(arena.attack(lambda: str(http.get("/jobs").status_code), seconds), "503", "200")
    finally:
        os.kill(server, signal.SIGCONT)


def scaled_calibrations(arena: Arena, seconds: float) -> Heard:
    """Calibrations that name 2, 10 and a million times the clip's size."""
    del seconds
    given, answers = json.loads(arena.clip.calibration.read_text()), Counter[str]()
    for factor in (2, 10, 10**6):
        changed = given | {name: given[name] * factor for name in ("width", "height")}
        answers[f"{factor:g}x: {_fate(arena, changed)}"] += 1
    told = ("422", "failed: calibration", *SCALE_CODES)
    return Heard(answers, all(any(each in answer for each in told) for answer in answers))


def _fate(arena: Arena, calibration: dict[str, Any]) -> str:
    """What becomes of the attacker's clip with this calibration."""
    files = {"clip": arena.clip.video.open("rb"), "calibration": ("c.json", json.dumps(calibration).encode())}
    with arena.http() as http, files["clip"]:
        sent = http.post("/reconstruct", files=files, data={"options": '{"iterations": 30}'})
    if sent.status_code != httpx.codes.ACCEPTED:
        return f"{sent.status_code} {sent.json().get('field')}"
    with arena.client as client:
        try:
            client.wait(sent.json()["id"])
        except JobRejected as rejected:
            return f"202, failed: {rejected.field}"
        codes = {each.code for each in client.report(sent.json()["id"]).warnings}
        return f"202, done, told: {', '.join(sorted(codes & {*SCALE_CODES})) or 'nothing'}"


def dripping_uploads(arena: Arena, seconds: float) -> Heard:
    """Eight uploads of 70 B/s; the other tenant's upload finds a place."""
    end_s = time.monotonic() + seconds

    def drip() -> str:
        address = httpx.URL(arena.url)
        head = (
            f"POST /reconstruct HTTP/1.1\r\nHost: {address.host}:{address.port}\r\n"
            f"Authorization: {arena.headers['Authorization']}\r\nContent-Length: 1000000\r\n"
            'Content-Type: multipart/form-data; boundary=x\r\n\r\n--x\r\nContent-Disposition: form-data; name="clip"; '
            'filename="a.mp4"\r\n\r\n'
        )
        with socket.create_connection((address.host, address.port or 80)) as line:
            line.sendall(head.encode())
            line.settimeout(DRIP_PERIOD_S)
            while time.monotonic() < end_s:
                try:
                    return line.recv(100).split()[1].decode()
                except TimeoutError:
                    line.sendall(bytes(DRIP_BYTES))
        return "held"

    with ThreadPoolExecutor(8) as threads:
        dripping = [threads.submit(drip) for _ in range(8)]
        time.sleep(seconds / 2)
        nothing = {"clip": ("a.mp4", b"")}
        other = httpx.post(f"{arena.url}/reconstruct", files=nothing, headers=arena.other, timeout=60).status_code
        answers = Counter(each.result() for each in dripping)
    is_bounded = answers["held"] <= UPLOADS_OF_TENANT and set(answers) <= {"held", "429", "408"} and other == 422
    return Heard(answers, is_bounded, f"the other tenant's upload was answered {other}")


def promises(arena: Arena, seconds: float) -> Heard:
    """Fourteen uploads of 4 GB of which no byte comes; the other tenant is promised room, too."""
    end_s = time.monotonic() + seconds
    metadata = f"part {base64.b64encode(b'clip').decode()},suffix {base64.b64encode(b'.mp4').decode()}"
    wanted = TUS | {"Upload-Length": str(4 * GIB - 1), "Upload-Metadata": metadata}
    with arena.http() as http:
        given = [http.post("/uploads", headers=wanted) for _ in range(14)]
        other = http.post("/uploads", headers=wanted | arena.other)
        time.sleep(max(0.0, end_s - time.monotonic()))
        for answer in (*given, other):
            if answer.status_code == httpx.codes.CREATED:
                whose = arena.other if answer is other else arena.headers
                http.delete(answer.headers["Location"], headers=TUS | whose)
    answers = Counter(str(each.status_code) for each in given)
    is_bounded = set(answers) == {"201", "429"} and other.status_code == httpx.codes.CREATED
    return Heard(answers, is_bounded, f"the other tenant's was answered {other.status_code}")


def _sent(arena: Arena, seconds: float, bodies: list[dict[str, Any]], *allowed: str) -> Heard:
    """What these bodies of POST /reconstruct are answered, one after the other."""
    turns = iter(range(10**9))
    with arena.http() as http:

        def send() -> str:
            return str(http.post("/reconstruct", **bodies[next(turns) % len(bodies)]).status_code)

        return _only(arena.attack(send, seconds), *allowed)


def _clip(calibration: bytes | None = CALIBRATION, name: str = "c.json", options: str = "{}") -> dict[str, Any]:
    files = {"clip": ("a.mp4", VIDEO.read_bytes())} | ({"calibration": (name, calibration)} if calibration else {})
    return {"files": files, "data": {"options": options}}


def without_scope(arena: Arena, seconds: float) -> Heard:
    """High priority, and trainings of an hour, by a key that may neither."""
    options = ('{"priority": "high"}', '{"budget_s": 3600}', '{"iterations": 1000000}')
    return _sent(arena, seconds, [_clip(options=each) for each in options], "403")


def deep_nesting(arena: Arena, seconds: float) -> Heard:
    """JSON and YAML nested a hundred thousand deep, wherever either is read."""
    deep = b"[" * 100_000
    yaml = b"%YAML:1.0\n---\nM1: " + b"{a: " * 100_000
    bodies = [_clip(deep), _clip(yaml, "c.yaml"), _clip(options='{"preset": ' + "[" * 100_000)]
    json_body = {"content": b'{"clip": ' + deep, "headers": {"Content-Type": "application/json"}}
    return _sent(arena, seconds, [*bodies, json_body], "422", "400", "413")


def slow_texts(arena: Arena, seconds: float) -> Heard:
    """Calibrations as large as they may be, of what takes long to look at."""
    pieces = (b"\n", b"[]", b"<!--", b"a: ", b"<a></a>", b"[[[[[[[[]]]]]]]]")
    texts = [piece * (MAX_CALIBRATION_BYTES // len(piece)) for piece in pieces]
    return _sent(arena, seconds, [_clip(text, "c.yaml") for text in texts], "422")


def no_numbers(arena: Arena, seconds: float) -> Heard:
    """Calibrations of NaN, infinity and without a camera, and two eyes without any."""
    yaml = b"%YAML:1.0\n---\nD1: [0, 0, 0, 0, 0]\n"
    bad = [CALIBRATION.replace(b'"fx_px": 90', b'"fx_px": ' + each) for each in (b"NaN", b"Infinity", b"-1e999")]
    bodies = [*(_clip(each) for each in bad), _clip(yaml, "c.yaml"), _clip(None, options='{"layout": "sbs"}')]
    return _sent(arena, seconds, bodies, "422")


def unknown_names(arena: Arena, seconds: float) -> Heard:
    """Names of queries that no route knows."""
    asked = [f"/render?scene={arena.scene}&layers=depth", "/jobs?stat=failed", f"/scenes/{arena.scene}?full=1"]
    with arena.http() as http:
        return _only(arena.attack(lambda: str(http.get(random.choice(asked)).status_code), seconds), "422")


def heads(arena: Arena, seconds: float) -> Heard:
    """HEAD of what GET answers."""
    paths = ("/healthz", "/jobs", f"/jobs/{arena.scene}", f"/scenes/{arena.scene}", "/openapi.json")
    with arena.http() as http:

        def ask() -> str:
            answer = http.head(random.choice(paths))
            return f"{answer.status_code}{' with a body' if answer.content else ''}"

        return _only(arena.attack(ask, seconds), "200")


def only_worker_dies(arena: Arena, seconds: float) -> Heard:
    """The only worker is killed: /readyz says so within a second, and again when another has taken its place."""
    del seconds
    sign = str(arena.data_dir).encode()
    worker = process(
        lambda command, entry: command.endswith(b"-m\0worker\0consume\0") and sign in (entry / "environ").read_bytes()
    )
    with arena.http() as http:
        os.kill(worker, signal.SIGKILL)
        killed_s = time.monotonic()
        answers: Counter[str] = Counter()
        while not answers["503"] and time.monotonic() < killed_s + 10:
            answers[str(http.get("/readyz").status_code)] += 1
        told_s = time.monotonic() - killed_s
        while http.get("/readyz").status_code != httpx.codes.OK:
            time.sleep(0.2)
    return Heard(answers, bool(answers["503"]) and told_s <= READY_WITHIN_S, f"503 after {told_s:.1f} s")


ATTACKS = (
    Attack(1, "six parallel renders of 4096x2160", large_renders),
    Attack(1, "four renders of 4096x2160 at a time, each abandoned after 1 s", abandoned_renders),
    Attack(1, "an image tag in a page from elsewhere", foreign_image),
    Attack(2, "the queue's server is stopped", queue_stopped),
    Attack(3, "calibrations for 2, 10 and 1e6 times the clip's size", scaled_calibrations, trains=True),
    Attack(4, "8 uploads of 70 B/s", dripping_uploads),
    Attack(4, "14 uploads of 4 GB announced, no byte sent", promises),
    Attack(5, "high priority, budget_s 3600, 1e6 iterations without their scopes", without_scope),
    Attack(7, "JSON and YAML nested 100,000 deep", deep_nesting),
    Attack(7, "calibrations of 250 kB that take long to look at", slow_texts),
    Attack(9, "calibrations of NaN, infinity, without a camera; two eyes without one", no_numbers),
    Attack(11, "query names that no route knows", unknown_names),
    Attack(11, "HEAD of what GET answers", heads),
    Attack(12, "the only worker is killed", only_worker_dies, stops_views=True),
)
