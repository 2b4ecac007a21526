"""POST /feeds/{id}/cut: a part of a feed's recording becomes an ordinary job.

The feed's worker joins the recorded packets without new encoding. The service fetches the file, stores it as if it had
been sent to POST /reconstruct with the feed's calibration, and queues the job.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import uuid
from pathlib import Path

from fastapi import APIRouter, Request, Response
from starlette.concurrency import run_in_threadpool

from contract.access.audit import AuditAction
from contract.access.keys import KeyScope
from contract.store.shelf import new_job_id
from contract.wire.feeds import CutJob, CutRange, FeedRecord, GivenCut
from contract.wire.labels import parse_labels
from contract.wire.rendering import CutRequest
from intrasplat.errors import InputError, LimitError, UnavailableError
from intrasplat.live.times import LIVE, FeedTime, FeedTimeKind
from intrasplat.options import JobOptions, parse_options
from service.bodies import CUT_BODY
from service.deps import AnyCaller, Deps, Services, owned_feed
from service.exports import next_part
from service.moments import feed_time
from service.problems import RETRY_AFTER_S, Problem, disk_full_for_upload
from service.reconstruct import IdempotencyKey, accept_clip, forecast_of, hash_of, read_json
from service.renders import problem_of_reply
from service.upload import LIMIT_REMEDY, Received

router = APIRouter(prefix="/feeds", tags=["feeds"])

MAX_BODY_BYTES = 128 * 1024
REMEDY = 'Send {"from": -30, "to": "live"}, and options as POST /reconstruct has them.'
SUFFIXES = {"video/mp4": ".mp4", "video/x-matroska": ".mkv"}
REPORTED_WITHIN_S = 2.0
"""Pairs that came since its worker's last report belong to a cut until live."""
WIDENED_S = 3.0
"""A cut may be so much longer than what is asked for: it begins and ends at key frames."""
MAX_WAIT_S = 120.0
"""How long the worker may take until the first bytes come."""


@router.post("/{feed_id}/cut", status_code=202, operation_id="cut_feed", openapi_extra=CUT_BODY)
async def cut_feed(
    feed_id: str,
    request: Request,
    response: Response,
    services: Services,
    caller: AnyCaller,
    idempotency_key: IdempotencyKey = None,
) -> CutJob:
    """Make a job of a part of the recording, in full quality and without new encoding. Location is the job.

    The part begins and ends at key frames; `cut` is its exact range.
    """
    caller.require(KeyScope.FEEDS)
    caller.require(KeyScope.RECONSTRUCT)
    feed = await run_in_threadpool(owned_feed, services, caller, feed_id)
    given = await read_json(request, services, GivenCut, MAX_BODY_BYTES, REMEDY)
    begins, ends = _range(given, feed, services.settings.max_clip_s)
    received = Received(
        options=json.dumps(_options(given, feed)),
        callback_url=given.callback_url,
        labels=parse_labels(given.label, given.metadata),
    )
    job_id = new_job_id()
    with services.intake.slot(caller.tenant):
        folder = services.store.open_incoming(job_id)
        try:
            outcome = f"ok (job {job_id})"
            await run_in_threadpool(services.audit.record, AuditAction.FEED_CUT, caller, feed_id, outcome)
            asked = CutRequest(scene_id=feed_id, begins=begins, ends=ends, export_id=uuid.uuid4().hex)
            cut = await _fetch(services, asked, folder, received)
            await run_in_threadpool(_add, folder, feed, received)
            key = hash_of(idempotency_key)
            record = await run_in_threadpool(accept_clip, services, caller, job_id, received, key)
        finally:
            await run_in_threadpool(services.store.discard_incoming, job_id)
    response.headers["Location"] = f"/jobs/{record.job_id}"
    response.headers["Retry-After"] = str(RETRY_AFTER_S)
    return CutJob.of_cut(record, cut, await run_in_threadpool(forecast_of, services, record))


def _options(given: GivenCut, feed: FeedRecord) -> dict[str, object]:
    """The options of the job: the feed's layout, unless another is named.

    Raises:
        InputError: an option is wrong.
    """
    parse_options(JobOptions, given.options)  # before anything is cut
    known = {} if feed.options.layout in ("auto", "two") else {"layout": feed.options.layout}
    return {**known, **given.options}


def _range(given: GivenCut, feed: FeedRecord, most_s: float) -> tuple[FeedTime, FeedTime]:
    """The UNIX times, or the seconds of the source, that a cut is to lie between.

    Raises:
        InputError: they name no moments, or no range.
        LimitError: it is longer than a clip may be.
        Problem: 409: nothing was recorded yet.
    """
    begins, ends = _moment("from", given.from_), _moment("to", given.to)
    from_s, to_s = _at_s("from", begins, feed), _at_s("to", ends, feed)
    if not from_s < to_s:
        raise InputError("from", f"{given.from_!r} is not before {given.to!r}.", "Give an earlier moment.")
    if to_s - from_s > most_s + REPORTED_WITHIN_S:
        problem = f"the part lasts {to_s - from_s:.1f} s; a clip may last {most_s:g} s."
        raise LimitError("from", problem, "Ask for a shorter part.")
    # The worker knows seconds of the source exactly: on both sides of a jump arrivals differ from them by other times.
    begins = begins if begins.kind is FeedTimeKind.SOURCE else FeedTime.at(from_s)
    return begins, ends if ends.kind is FeedTimeKind.SOURCE else FeedTime.at(to_s)


def _moment(field: str, asked: float | str) -> FeedTime:
    try:
        return feed_time(asked)
    except InputError as error:
        raise InputError(field, error.problem, error.remedy) from None


def _at_s(field: str, moment: FeedTime, feed: FeedRecord) -> float:
    """The UNIX time of a moment; of seconds of the source, as far from the newest moment as these are."""
    if moment.kind is FeedTimeKind.UNIX:
        return moment.seconds
    report = feed.report
    newest_s = None if report is None else report.last_frame_at_s or report.ends_s
    if report is None or newest_s is None:
        remedy = f"Wait until it is live: GET /feeds/{feed.feed_id}/events."
        raise Problem(409, "The feed has recorded nothing yet.", field="feed_id", remedy=remedy)
    if moment == LIVE:
        return max(newest_s, min(time.time(), newest_s + REPORTED_WITHIN_S))
    if moment.kind is FeedTimeKind.BEFORE_LIVE:
        return newest_s - moment.seconds
    if report.ends_s is None or report.source_ends_s is None:
        remedy = "Give seconds before live, or a time of RFC 3339."
        raise Problem(409, "The feed has no model yet that knows its seconds.", field=field, remedy=remedy)
    return report.ends_s - (report.source_ends_s - moment.seconds)


async def _fetch(services: Deps, request: CutRequest, folder: Path, received: Received) -> CutRange:
    """Write the file that the worker makes into `folder`.

    Raises:
        Problem: the worker's error; 507: the disk has no space for it.
        LimitError: the file is larger than an upload may be, or has more frames than a clip may have.
        UnavailableError: the worker has ended or is too slow, or says not what the file holds.
    """
    available_bytes, until_s = services.intake.available_bytes(), time.monotonic() + MAX_WAIT_S
    answer, part, cut = await next_part(services, request, None), 0, None
    digest, path = hashlib.sha256(), folder / "clip"
    with path.open("xb") as file:
        while True:
            if answer.head.error is not None:
                raise problem_of_reply(answer.head.error)
            cut = cut or answer.head.cut
            if cut is not None and cut.frames > services.settings.max_frames:
                raise _too_many_frames(cut, services.settings.max_frames)
            received.total_bytes += len(answer.body)
            _check_size(services, received.total_bytes, available_bytes)
            digest.update(answer.body)
            await run_in_threadpool(file.write, answer.body)
            suffix = SUFFIXES.get(answer.head.media_type, ".mp4")
            if not answer.head.more:
                break
            if not received.total_bytes and time.monotonic() > until_s:
                raise UnavailableError(f"The cut took more than {MAX_WAIT_S:g} s.", "Ask for a shorter part.")
            part += 1
            answer = await next_part(services, request.model_copy(update={"part": part}), answer.worker)
        file.flush()
        await run_in_threadpool(os.fsync, file.fileno())
    if cut is None:
        problem = "The worker did not say what the cut holds."
        raise UnavailableError(problem, "Start service and worker from the same version.")
    path.rename(folder / f"clip{suffix}")
    received.names["clip"], received.digests["clip"] = f"clip{suffix}", digest.hexdigest()
    return cut


def _check_size(services: Deps, size_bytes: int, available_bytes: int) -> None:
    settings = services.settings
    if size_bytes > settings.max_upload_bytes:
        raise LimitError("from", f"the part is larger than {settings.max_upload_bytes} bytes.", LIMIT_REMEDY)
    if size_bytes > available_bytes:
        raise disk_full_for_upload(size_bytes, available_bytes, settings.min_free_bytes)


def _too_many_frames(cut: CutRange, most: int) -> LimitError:
    problem = f"the part has {cut.frames} frames; a clip may have {most} (INTRASPLAT_MAX_FRAMES)."
    possible_s = (cut.to_s - cut.from_s) * most / cut.frames - WIDENED_S
    return LimitError("from", problem, f"At this frame rate ask for at most {max(1, int(possible_s))} s.")


def _add(folder: Path, feed: FeedRecord, received: Received) -> None:
    """Add the feed's calibration to the received files."""
    content = feed.calibration.encode()
    with (folder / feed.calibration_name).open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    received.names["calibration"] = feed.calibration_name
    received.digests["calibration"] = hashlib.sha256(content).hexdigest()
    received.total_bytes += len(content)
