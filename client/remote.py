"""The commands that call a service: submit, import, watch, fetch, jobs, cancel, retry, delete."""

from __future__ import annotations

import argparse
import json
import os
import sys
from contextlib import AbstractContextManager
from datetime import datetime
from pathlib import Path

from client.connected import KEY_VARIABLE, Remedies, connected
from contract.wire.job import JobProgress
from contract.wire.labels import NO_NAMES
from contract.wire.webhooks import CALLBACK_ABOUT
from intrasplat.commands.arguments import Commands, add_command, add_options, count, finite, given_options
from intrasplat.commands.exits import ExitCode
from intrasplat.commands.progress_bar import ProgressBar
from intrasplat.errors import InputError, SceneError
from intrasplat.names import MANIFEST
from intrasplat.options import JobOptions
from intrasplat_client import Client, Conflict, JobState, JobView
from intrasplat_client.connection import DEFAULT_URL

URL_VARIABLE = "INTRASPLAT_URL"


def add_remote(commands: Commands) -> None:
    """Add the parsers of all these commands."""
    _add_submit(commands)
    watch = add_command(commands, "watch", "wait for a job, with a progress bar", _watch)
    _add_fetch(commands)
    _add_import(commands)
    jobs = add_command(commands, "jobs", "list the newest jobs, newest first", _jobs)
    jobs.add_argument("--state", choices=[state.value for state in JobState], help="only jobs in this state")
    jobs.add_argument("--limit", type=count, metavar="N", help="at most N jobs (default: 200)")
    jobs.add_argument("--find", metavar="WORDS", help="only jobs with these words in label, metadata or id")
    jobs.add_argument("--preset", help="only jobs of this preset")
    jobs.add_argument("--since", type=_date, metavar="DATE", help="only jobs submitted then or later: 2026-05-04")
    jobs.add_argument("--until", type=_date, metavar="DATE", help="only jobs submitted before: 2026-05-05T12:00")
    _add_metadata(jobs, "only jobs with this in their metadata; may come several times")
    label = add_command(commands, "label", "change a job's label and metadata", _label)
    label.add_argument("--label", metavar="TEXT", help=f"the new label; '' removes it. {NO_NAMES}")
    _add_metadata(label, "in place of all metadata that was there; may come several times")
    label.add_argument("--no-metadata", action="store_true", help="remove all metadata")
    cancel = add_command(commands, "cancel", "stop a job and remove its clip", _cancel)
    retry = add_command(commands, "retry", "queue a failed job again", _retry)
    delete = add_command(commands, "delete", "remove clip, scene and record of a job that has ended", _delete)
    for parser in (watch, label, cancel, retry, delete):
        parser.add_argument("job", metavar="JOB", help="the id that submit printed")
    for parser in (watch, jobs, label, cancel, retry, delete):
        add_service(parser)


def _add_submit(commands: Commands) -> None:
    parser = add_command(commands, "submit", "send a clip to a service and print its job's id", _submit)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "clip", type=Path, metavar="INPUT", nargs="?", help="a video or a zip; both eyes, or the left one"
    )
    parser.add_argument(
        "right", type=Path, metavar="RIGHT", nargs="?", help="the right eye, if it is a file of its own"
    )
    parser.add_argument("--calibration", type=Path, metavar="F", help="JSON, OpenCV YAML or XML, or ini")
    parser.add_argument(
        "--masks", type=Path, metavar="F", help="zip of PNGs or a video: the instruments, of the left eye or of both"
    )
    parser.add_argument(
        "--fov-mask", type=Path, metavar="F", help="PNG of the field of view, white inside: of the left eye, or of both"
    )
    parser.add_argument("--poses-file", type=Path, metavar="F", help="the camera's poses: TUM, or a matrix a frame")
    source.add_argument(
        "--clip-of",
        metavar="JOB",
        help="instead of INPUT: use this job's clip again, with its calibration and masks unless others are given",
    )
    add_options(parser, JobOptions)
    parser.add_argument("--label", metavar="TEXT", help=f"a text to find the job by. {NO_NAMES}")
    _add_metadata(parser, f"a text to find the job by; may come several times. {NO_NAMES}")
    parser.add_argument("--callback-url", metavar="URL", help=CALLBACK_ABOUT)
    parser.add_argument("--idempotency-key", metavar="TEXT", help="the same key with the same clip is the same job")
    parser.add_argument("--watch", action="store_true", help="wait for the scene, with a progress bar")
    add_service(parser)


def _add_fetch(commands: Commands) -> None:
    parser = add_command(
        commands, "fetch", "save a finished scene's report, curve, picture, Gaussians and found masks", _fetch
    )
    parser.add_argument("job", metavar="JOB", help="the id that submit printed")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder to write into; created if it is missing"
    )
    parser.add_argument(
        "--t", type=finite, default=0.0, help="time of picture and Gaussians, as a fraction of the clip (default: 0)"
    )
    parser.add_argument(
        "--pose",
        help="world_from_camera, 12 or 16 numbers in mm, or orbit:YAW,PITCH,ZOOM[,X,Y,Z]: degrees, times nearer, "
        "and the point looked at in mm "
        "(default: the endoscope's own)",
    )
    parser.add_argument("--no-ply", action="store_true", help="leave the Gaussians out")
    parser.add_argument(
        "--scene", action="store_true", help="the stored scene, too, into DIR/scene: `intrasplat render` reads it"
    )
    add_service(parser)


def _add_import(commands: Commands) -> None:
    parser = add_command(
        commands, "import", "send a scene that another installation exported, and print its job's id", _import
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="made there with format=scene")
    parser.add_argument("--retention-hours", type=finite, metavar="H", help="purge the scene so many hours later")
    parser.add_argument("--label", metavar="TEXT", help=f"a text to find the scene by. {NO_NAMES}")
    _add_metadata(parser, f"a text to find the scene by; may come several times. {NO_NAMES}")
    parser.add_argument("--callback-url", metavar="URL", help=CALLBACK_ABOUT)
    parser.add_argument("--idempotency-key", metavar="TEXT", help="the same key with the same file is the same scene")
    parser.add_argument("--watch", action="store_true", help="wait for the scene, with a progress bar")
    add_service(parser)


def _add_metadata(parser: argparse.ArgumentParser, help_text: str) -> None:
    parser.add_argument("--metadata", type=_entry, action="append", metavar="NAME=VALUE", help=help_text)


def _entry(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r} has no =.")
    return name, value


def _date(text: str) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no date such as 2026-05-04 or 2026-05-04T12:00.") from None


def add_service(parser: argparse.ArgumentParser) -> None:
    """Add --url and --api-key."""
    url = os.environ.get(URL_VARIABLE) or DEFAULT_URL
    parser.add_argument("--url", default=url, help=f"the service (default: {URL_VARIABLE}, or {DEFAULT_URL})")
    parser.add_argument(
        "--api-key",
        default=os.environ.get(KEY_VARIABLE) or None,
        metavar="KEY",
        help=f"from `intrasplat keys create` (default: {KEY_VARIABLE}, which no list of processes shows)",
    )


def _client(options: argparse.Namespace, if_conflict: str | None = None) -> AbstractContextManager[Client]:
    """A client of the chosen service; if_conflict: the remedy where the job's state does not allow the command."""
    remedies: Remedies = {} if if_conflict is None else {Conflict: if_conflict}
    return connected(options.url, options.api_key, remedies)


def _submit(options: argparse.Namespace) -> int:
    chosen = given_options(options, JobOptions).model_dump(exclude_unset=True)
    with _client(options) as client:
        with ProgressBar(sys.stderr) as bar:
            job = client.reconstruct(
                options.clip,
                options.right,
                clip_of=options.clip_of,
                calibration=options.calibration,
                masks=options.masks,
                poses_file=options.poses_file,
                fov_mask=options.fov_mask,
                label=options.label,
                metadata=dict(options.metadata or ()),
                callback_url=options.callback_url,
                idempotency_key=options.idempotency_key,
                on_upload=lambda sent, total: bar.show(JobProgress(stage="upload", fraction=sent / total)),
                **chosen,
            )
        print(job.id, flush=True)
        return _show_until_done(client, job.id) if options.watch else ExitCode.OK


def _import(options: argparse.Namespace) -> int:
    with _client(options) as client:
        with ProgressBar(sys.stderr) as bar:
            job = client.import_scene(
                options.file,
                label=options.label,
                metadata=dict(options.metadata or ()),
                callback_url=options.callback_url,
                retention_hours=options.retention_hours,
                idempotency_key=options.idempotency_key,
                on_upload=lambda sent, total: bar.show(JobProgress(stage="upload", fraction=sent / total)),
            )
        print(job.id, flush=True)
        return _show_until_done(client, job.id) if options.watch else ExitCode.OK


def _watch(options: argparse.Namespace) -> int:
    with _client(options) as client:
        return _show_until_done(client, options.job)


def _show_until_done(client: Client, job_id: str) -> int:
    try:
        with ProgressBar(sys.stderr) as bar:
            client.wait(job_id, on_progress=lambda job: bar.show(progress_of(job)))
    except KeyboardInterrupt:
        again = f"`intrasplat watch {job_id}` shows it, `intrasplat cancel {job_id}` ends it"
        print(f"intrasplat: the job goes on; {again}.", file=sys.stderr)
        raise
    print(f"done: `intrasplat fetch {job_id} --out DIR`, or {client.url}/render?scene={job_id}", file=sys.stderr)
    return ExitCode.OK


def progress_of(job: JobView) -> JobProgress:
    """The progress bar's content: the stage, or the state of a job that has not reported a stage."""
    if job.stage is None or job.state is JobState.QUEUED:
        return JobProgress(stage=job.state.value, fraction=0.0, seconds_left=job.eta_s)
    return JobProgress(
        stage=job.stage,
        fraction=job.fraction or 0.0,
        iteration=job.iteration or 0,
        iterations=job.iterations or 0,
        psnr_db=job.psnr_db,
        psnr_right_db=job.psnr_right_db,
        seconds_left=job.seconds_left,
    )


def _fetch(options: argparse.Namespace) -> int:
    with _client(options, f"See `intrasplat watch {options.job}`.") as client:
        report = client.report(options.job)
        files: dict[str, bytes] = {
            "report.json": report.model_dump_json(indent=1).encode(),
            "curve.csv": client.curve(options.job).encode(),
            "view.png": client.render(options.t, scene=options.job, pose=options.pose).content,
        }
        if report.masks is not None and report.masks.source in ("found", "segmenter") and report.masks.share > 0:
            files["masks.zip"] = client.masks(options.job)
        if not options.no_ply:
            files["scene.ply"] = client.export(options.job, options.t)
        if options.scene:
            files |= {f"scene/{name}": content for name, content in _stored_files(client, options.job).items()}
    try:
        for name, content in files.items():
            (options.out / name).parent.mkdir(parents=True, exist_ok=True)
            (options.out / name).write_bytes(content)
            print(options.out / name)
    except OSError as error:
        raise InputError("--out", f"{options.out} cannot be written ({error.strerror}).", "Name a folder.") from error
    return ExitCode.OK


def _stored_files(client: Client, scene: str) -> dict[str, bytes]:
    """The scene's stored files by name; the manifest last, because a scene exists only with it."""
    manifest = client.file(scene, MANIFEST)
    try:
        names = [*json.loads(manifest)["files"]]
    except (ValueError, KeyError, TypeError) as error:
        raise SceneError(f"The manifest of scene {scene} is damaged.") from error
    return {Path(name).name: client.file(scene, name) for name in names} | {MANIFEST: manifest}


def _jobs(options: argparse.Namespace) -> int:
    with _client(options) as client:
        found = client.jobs(
            options.state,
            options.limit,
            q=options.find,
            metadata=dict(options.metadata or ()),
            preset=options.preset,
            created_from_s=options.since,
            created_until_s=options.until,
        )
    for job in found:
        label = "" if job.label is None else f"[{job.label}]  "
        print(f"{job.id}  {job.state.value:<9}  {label}{_detail_of(job)}".rstrip())
    return ExitCode.OK


def _label(options: argparse.Namespace) -> int:
    metadata = {} if options.no_metadata else dict(options.metadata) if options.metadata else None
    if options.label is None and metadata is None:
        raise InputError("--label", "there is nothing to change.", "Give --label, --metadata or --no-metadata.")
    with _client(options) as client:
        job = client.label(options.job, options.label, metadata)
    for line in (job.label or "", *(f"{name}={value}" for name, value in job.metadata.items())):
        print(line)
    return ExitCode.OK


def _detail_of(job: JobView) -> str:
    if job.state is JobState.FAILED and job.error is not None:
        return ": ".join(part for part in (job.error.field, job.error.problem) if part)
    if job.state is JobState.RUNNING and job.stage is not None:
        return f"{job.stage} {job.fraction or 0.0:.0%}"
    if job.state is JobState.DONE and job.psnr_db is not None:
        return f"{job.psnr_db:.2f} dB on held-out frames"
    return ""


def _cancel(options: argparse.Namespace) -> int:
    with _client(options, f"`intrasplat delete {options.job}` removes what is left of it.") as client:
        job = client.cancel(options.job)
    print("cancelled" if job.state is JobState.CANCELLED else "it stops as soon as its worker hears of it")
    return ExitCode.OK


def _retry(options: argparse.Namespace) -> int:
    remedy = f"See `intrasplat watch {options.job}`; if its clip is gone, send it again with `intrasplat submit`."
    with _client(options, remedy) as client:
        print(client.retry(options.job).state.value)
    return ExitCode.OK


def _delete(options: argparse.Namespace) -> int:
    with _client(options, f"Cancel it first: `intrasplat cancel {options.job}`.") as client:
        print(json.dumps(client.delete(options.job), indent=1))
    return ExitCode.OK
