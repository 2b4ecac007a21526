"""`make images-check`: build both images with buildah, run them with podman as compose.yml says, and try them.

It prints a line for each thing that it tried, and ends with status 1 if one is not as it should be. Where programs are
missing that it cannot do without, it names them, tries nothing, and ends with status 0. Run it as root. What follows
`--` goes to `buildah bud`, for machines that reach no registry: `make images-check ARGS="-- --pull-never"`.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from composition import DOCKER, PROJECT, Composition, podman
from PIL import Image as Picture
from PIL import ImageStat
from proxies import Site, protocol, proxy, site_in
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect
from websockets.typing import Origin

from intrasplat_client import Client, JobState, JobView
from intrasplat_client.errors import IntrasplatError

NEEDED = ("buildah", "podman", "openssl")
PROXIES = ("nginx", "caddy")
BUILT = ("service", "worker")
USER = "10001"
UNPROXIED_URL = "http://127.0.0.1:8765"
CLIP = ("--frames", "12", "--width", "160", "--height", "128")
MADE_BY_PODMAN = ("/etc", "/run", "/run/secrets", "/data", "/tmp")
"""Folders in which it mounts something, as it tells of its own."""
LONG_ITERATIONS = 5000
"""Of the job that is interrupted: it trains longer than its worker needs to be told."""
STEPS_BEFORE = 100
"""It is interrupted only then, so that training which begins again would be seen."""
PATIENCE_S = 300.0
FAULTS = (RuntimeError, OSError, subprocess.SubprocessError, IntrasplatError, WebSocketException)
"""Of programs, the service and its connections: they end the check, and are told in its table."""


class Table:
    """The lines that are printed, as soon as each is known."""

    def __init__(self) -> None:
        self.is_sound = True
        self.not_tried: list[str] = []

    def row(self, topic: str, found: str, is_right: bool = True) -> None:
        """Print what was found, and remember if it is not as it should be."""
        self.is_sound &= is_right
        print(f"{'ok' if is_right else 'WRONG':<6} {topic:<38} {found}", flush=True)

    def end(self) -> int:
        """Print what came of it; the exit status."""
        verdict = "all that was tried is as it should be" if self.is_sound else "see the lines marked WRONG"
        left_out = f"; not here, so not tried: {', '.join(self.not_tried)}" if self.not_tried else ""
        print(f"images-check: {verdict}{left_out}")
        return 0 if self.is_sound else 1


def main(argv: Sequence[str] | None = None) -> int:
    """Try all of it; the exit status."""
    parser = argparse.ArgumentParser(prog="images-check", description="Build the images and run them.")
    parser.add_argument("--built", action="store_true", help="the images are built already: run them")
    parser.add_argument("build_options", nargs="*", metavar="OPTION", help="after --: of `buildah bud`")
    arguments = parser.parse_args(argv)
    missing = [program for program in NEEDED if shutil.which(program) is None]
    if missing:
        print(f"images-check: NOTHING WAS CHECKED, for this machine has no {', '.join(missing)}")
        return 0
    table = Table()
    try:
        with tempfile.TemporaryDirectory(prefix=f"{PROJECT}-") as folder:
            site = site_in(Path(folder))
            os.environ["SSL_CERT_FILE"] = str(site.folder / "cert.pem")  # for the clients of this process
            with Composition(site.name) as composition:
                for name in BUILT:
                    build(table, name, composition.services[name]["image"], arguments)
                run(table, composition, site)
    except FAULTS as error:
        table.row("the check ended here", str(error), is_right=False)
    return table.end()


def build(table: Table, name: str, image: str, arguments: argparse.Namespace) -> None:
    """Build an image from its Dockerfile, unless it is built."""
    began_s = time.monotonic()
    if not arguments.built:
        command = ["buildah", "bud", "--format", "docker", "--layers", *arguments.build_options]
        command += ["--file", str(DOCKER / f"{name}.Dockerfile"), "--tag", image, str(DOCKER.parent)]
        built = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        if built.returncode != 0:
            raise RuntimeError(f"{' '.join(command)}: status {built.returncode}\n{built.stdout[-3000:]}")
    took = "was there" if arguments.built else f"in {time.monotonic() - began_s:.0f} s"
    (base,) = re.findall(r"^ARG BASE=(\S+)", (DOCKER / f"{name}.Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)
    table.row(f"image {name}", f"{_size_mb(image):.0f} MB, of which {_size_mb(base):.0f} MB are {base}; {took}")


def _size_mb(image: str) -> float:
    return float(json.loads(podman("image", "inspect", image))[0]["Size"]) / 1e6


def run(table: Table, composition: Composition, site: Site) -> None:
    """Run queue, service and worker, and try them."""
    table.row("queue: well after", f"{composition.start('queue'):.1f} s")
    key = composition.once("service", "intrasplat", "keys", "create", "--tenant", "check")
    for name in BUILT:
        table.row(f"{name}: well after", f"{composition.start(name):.1f} s")
    for name in composition.services:
        confinement(table, composition, name)
    programs(table, composition)
    clip = site.folder / "clip"
    command = [sys.executable, "-m", "lab", "phantom", *CLIP, "--out", str(clip / "made")]
    subprocess.run(command, cwd=DOCKER.parent, check=True)
    for program in PROXIES:
        if shutil.which(program) is None:
            table.not_tried.append(program)
            continue
        with proxy(program, site):
            journey(table, composition, site, program, key, clip / "made")
    with Client(UNPROXIED_URL, api_key=key) as client:
        interruption(table, composition, client, clip / "made")
    for name in composition.services:
        changed = [line for line in composition.changed(name) if line[2:] not in MADE_BY_PODMAN]
        table.row(f"{name}: files changed outside of volumes", ", ".join(changed) or "none", not changed)


def confinement(table: Table, composition: Composition, name: str) -> None:
    """What the kernel says of the container's first process."""
    status = dict(line.split(":\t", 1) for line in composition.run(name, "cat", "/proc/1/status").splitlines())
    user, rights = status["Uid"].split()[1], int(status["CapEff"], 16) | int(status["CapPrm"], 16)
    wanted = composition.services[name].get("user", USER).partition(":")[0]
    table.row(f"{name}: user, capabilities", f"{user}, {rights:#x}", user == wanted and rights == 0)
    no_more = status["NoNewPrivs"].strip()
    can_write = (
        composition.status(name, "touch", "/written") == 0 or composition.status(name, "touch", "/run/written") == 0
    )
    table.row(
        f"{name}: root, new privileges",
        f"{'writable' if can_write else 'read-only'}, {'none' if no_more == '1' else 'possible'}",
        not can_write and no_more == "1",
    )


def programs(table: Table, composition: Composition) -> None:
    """The command line in both images, and what must not be reached from the worker."""
    doctor = composition.run("worker", "intrasplat", "doctor").splitlines()
    faults = [line for line in doctor if line.startswith("missing")]
    table.row("worker: `intrasplat doctor`", "; ".join(faults) or f"{len(doctor)} lines, nothing missing", not faults)
    status = composition.status("service", "intrasplat", "doctor")
    table.row("service: `intrasplat doctor`", f"status {status}: needs the worker's packages", status == 5)
    routes = composition.run("worker", "cat", "/proc/net/route").splitlines()[1:]
    ways_out = [line.split()[0] for line in routes if int(line.split()[1], 16) == 0]
    table.row("worker: way out of its network", ", ".join(ways_out) or "none", not ways_out)


def journey(table: Table, composition: Composition, site: Site, program: str, key: str, clip: Path) -> None:
    """A clip from POST to its picture, through a proxy."""
    began_s = time.monotonic()
    with Client(site.url, api_key=key) as client:
        job = client.reconstruct(
            clip / "stereo.webm",
            calibration=clip / "calibration.json",
            masks=clip / "masks.zip",
            preset="instant",
            label=program,
        )
        client.wait(job.id)
        picture = client.render(0.5, scene=job.id).content
        took_s = time.monotonic() - began_s
        table.row(f"{program}: POST to picture over TLS", f"{took_s:.1f} s, {_told(picture)}", _is_picture(picture))
        report = client.report(job.id)
    (decoding,) = (each.text for each in report.assumptions if each.code == "decoding")
    table.row(f"{program}: sandbox of the decoder", decoding, "did not grant" not in decoding)
    spoken = protocol(site)
    table.row(f"{program}: protocol", spoken, spoken == "h2")
    table.row(f"{program}: stream to a browser", _streamed(site, key, job.id))
    lines = [json.loads(line) for line in composition.run("service", "cat", "/data/audit.jsonl").splitlines()]
    (address,) = {line["address"] for line in lines if line.get("job_id") == job.id and line["action"] == "accepted"}
    table.row(f"{program}: caller in the audit", f"{address} (gateway: {composition.gateway})", address == site.address)


def interruption(table: Table, composition: Composition, client: Client, clip: Path) -> None:
    """SIGTERM to a worker that trains: the job is handed back, and goes on with the next start."""
    job = client.reconstruct(
        clip / "stereo.webm", calibration=clip / "calibration.json", preset="quality", iterations=LONG_ITERATIONS
    )
    before = _until(client, job.id, lambda now: now.stage == "train" and (now.iteration or 0) >= STEPS_BEFORE)
    took_s = composition.stop("worker")
    status = composition.field("worker", "State.ExitCode")
    after = client.job(job.id)
    found = f"ended in {took_s:.1f} s with status {status}; the job is {after.state}"
    table.row("worker: SIGTERM in training", found, status == "0" and after.state is JobState.QUEUED)
    composition.start_again("worker")
    again = _until(client, job.id, lambda now: now.stage == "train" and (now.iteration or 0) > 0)
    went_on = (again.iteration or 0) >= (before.iteration or 0)
    table.row("worker: started again", f"step {before.iteration} before, {again.iteration} after", went_on)
    client.cancel(job.id)
    _until(client, job.id, lambda now: now.state is JobState.CANCELLED)


def _until(client: Client, job_id: str, is_so: Callable[[JobView], bool]) -> JobView:
    deadline_s = time.monotonic() + PATIENCE_S
    while not is_so(job := client.job(job_id)):
        if time.monotonic() > deadline_s or job.state in (JobState.FAILED, JobState.DONE):
            raise RuntimeError(f"the job is {job.state} in the stage {job.stage}: {job.error}")
        time.sleep(0.2)
    return job


def _streamed(site: Site, key: str, scene: str) -> str:
    """A view by WebSocket as a browser asks for it: with an Origin, the key in the first message."""
    with connect(f"wss{site.url.removeprefix('https')}/stream", origin=Origin(site.url), max_size=None) as viewer:
        viewer.send(json.dumps({"authorize": key}))
        viewer.send(json.dumps({"scene": scene, "t": 0.5, "format": "png"}))
        message = viewer.recv(timeout=30)
    if not isinstance(message, bytes):
        raise RuntimeError(f"/stream answers {message}")
    return _told(message[4 + int.from_bytes(message[:4], "big") :])


def _told(picture: bytes) -> str:
    with Picture.open(io.BytesIO(picture)) as image:
        return f"{image.width}x{image.height} {image.format}"


def _is_picture(picture: bytes) -> bool:
    """Whether it shows anything."""
    with Picture.open(io.BytesIO(picture)) as image:
        return max(ImageStat.Stat(image).stddev) > 1


if __name__ == "__main__":
    sys.exit(main())
