"""Routes of /feeds: open, list, show, watch, pause and end live feeds.

The queue has the feeds. A worker with a free place claims one, follows it and reports; the service changes what its
caller wishes and shows what the worker said last. Renders of a feed are those of scenes, with the feed's id.
"""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import Callable

from fastapi import APIRouter, Request, Response
from fastapi.sse import EventSourceResponse
from starlette.concurrency import run_in_threadpool

from contract.access.audit import AuditAction, utc_now
from contract.access.keys import KeyScope
from contract.runtime.feed_sources import allowed_hosts
from contract.wire.feeds import FeedOptions, FeedReceipt, FeedRecord, FeedView, FeedWish
from intrasplat.errors import InputError
from intrasplat.intake.calibration.encoding import decoded_text
from intrasplat.intake.sniff import check_file
from intrasplat.live.state import FeedReason, FeedState
from intrasplat.options import FIELD_PREFIX, parse_options
from service.access import Caller
from service.bodies import FEED_BODY
from service.deps import AnyCaller, Deps, Services, owned_feed
from service.jobs import STREAM_HEADERS
from service.problems import RETRY_AFTER_S
from service.reconstruct import IdempotencyKey, hash_of, receive_form
from service.upload import CALIBRATION_PART, FEED_FORM, Received

router = APIRouter(prefix="/feeds", tags=["feeds"])

FOLLOWED_WITHIN_S = 3.0
"""How long a request waits until the feed's worker has done what it asks for. A worker reads wishes twice a second."""
LOOK_PERIOD_S = 0.1

EVENTS: dict[int | str, dict[str, object]] = {
    200: {"description": "server-sent events", "content": {EventSourceResponse.media_type: {}}}
}
NOT_YET: dict[int | str, dict[str, object]] = {
    202: {"description": "it is wished; no worker has done it yet", "model": FeedView}
}


@router.post("", status_code=201, operation_id="open_feed", openapi_extra=FEED_BODY)
async def open_feed(
    request: Request, response: Response, services: Services, caller: AnyCaller, idempotency_key: IdempotencyKey = None
) -> FeedView:
    """Open a live feed. Location is the feed, whose id is a `scene` for renders, streams and exports.

    Whether the source can be reached and the calibration fits is the feed's state. The same Idempotency-Key with the
    same options and calibration is the same feed.
    """
    caller.require(KeyScope.FEEDS)
    record = await receive_form(request, services, caller, hash_of(idempotency_key), _accept, FEED_FORM)
    response.headers["Location"] = f"/feeds/{record.feed_id}"
    return _view(record)


@router.get("", operation_id="list_feeds")
def list_feeds(services: Services, caller: AnyCaller) -> list[FeedView]:
    """The open feeds, newest first."""
    caller.require(KeyScope.VIEW)
    return [_view(each) for each in services.queue.feeds(caller.tenant)]


@router.get("/{feed_id}", operation_id="get_feed")
def get_feed(feed_id: str, services: Services, caller: AnyCaller) -> FeedView:
    """State, reason and numbers as its worker reported them last, at most a second ago while one follows it."""
    caller.require(KeyScope.VIEW)
    return _view(owned_feed(services, caller, feed_id))


@router.get("/{feed_id}/events", operation_id="watch_feed", response_class=Response, responses=EVENTS)
async def watch_feed(feed_id: str, services: Services, caller: AnyCaller) -> Response:
    """Server-sent events `feed` whose data is the feed: on each change of its state, and once a second.

    The stream ends when the feed has ended; asked for again, the answer is 404.
    """
    caller.require(KeyScope.VIEW)
    await run_in_threadpool(owned_feed, services, caller, feed_id)
    return EventSourceResponse(services.feed_channels.stream(feed_id), headers=STREAM_HEADERS)


@router.post("/{feed_id}/pause", operation_id="pause_feed", responses=NOT_YET)
async def pause_feed(feed_id: str, response: Response, services: Services, caller: AnyCaller) -> FeedView:
    """Stop reading, recording and learning now. 200: it has stopped. Its past stays."""
    await _wish(services, caller, feed_id, FeedWish.PAUSE, AuditAction.FEED_PAUSED)
    return await _when(services, response, feed_id, caller, lambda feed: feed.state is FeedState.PAUSED)


@router.post("/{feed_id}/resume", operation_id="resume_feed", responses=NOT_YET)
async def resume_feed(feed_id: str, response: Response, services: Services, caller: AnyCaller) -> FeedView:
    """Go on after a pause. 200: the source is read again."""
    await _wish(services, caller, feed_id, FeedWish.RUN, AuditAction.FEED_RESUMED)
    return await _when(services, response, feed_id, caller, _is_read)


@router.delete(
    "/{feed_id}",
    operation_id="end_feed",
    responses={202: {"description": "it is wished; its worker has not deleted all of it yet", "model": FeedReceipt}},
)
async def end_feed(feed_id: str, response: Response, services: Services, caller: AnyCaller) -> FeedReceipt:
    """End a feed and delete all that belongs to it: recording, model and past. Jobs of its cuts stay.

    200: it is gone, as the receipt says. 202: its worker has not done so yet; GET /feeds/{feed_id} shows it until then.
    """
    ended_at = utc_now()
    before = await _wish(services, caller, feed_id, FeedWish.END, AuditAction.FEED_ENDED)
    until_s = time.monotonic() + FOLLOWED_WITHIN_S
    while await run_in_threadpool(services.queue.tenant_of_feed, feed_id) is not None:
        if time.monotonic() > until_s:
            response.status_code = 202
            response.headers["Retry-After"] = str(RETRY_AFTER_S)
            break
        await asyncio.sleep(LOOK_PERIOD_S)
    services.feeds.forget(feed_id)
    is_gone = response.status_code != 202
    has_files = feed_id in await run_in_threadpool(services.feed_files.ids)
    stored_bytes = before.report.stored_bytes if before.report else 0
    return FeedReceipt(
        feed_id=feed_id, ended_at=ended_at, bytes=stored_bytes, record=is_gone, verified=is_gone and not has_files
    )


def _accept(services: Deps, caller: Caller, feed_id: str, received: Received, key: str | None) -> FeedRecord:
    """Open the feed that a form describes."""
    options = _options(services, received.options)
    calibration, name = _calibration(services, feed_id, received)
    if key is not None:
        feed_id = hashlib.sha256(f"{caller.tenant}\n{key}".encode()).hexdigest()[: len(feed_id)]
    record = FeedRecord(
        feed_id=feed_id,
        tenant=caller.tenant,
        options=options,
        calibration=calibration,
        calibration_name=name,
        created_at_s=time.time(),
    )
    services.audit.record(AuditAction.FEED_OPENED, caller, feed_id)
    settings = services.settings
    standing = services.queue.open_feed(record, settings.max_feeds, settings.feeds_of_tenant)
    if (standing.options, standing.calibration) != (options, calibration):
        problem = f"it was used for the feed {feed_id} with other options or another calibration."
        raise InputError("Idempotency-Key", problem, "Use a new key for every new feed.")
    return standing


def _options(services: Deps, text: str) -> FeedOptions:
    """The options of a feed, as far as they can be checked without its source.

    Raises:
        InputError: names the option that cannot be used.
    """
    options, most_s = parse_options(FeedOptions, text), services.settings.feed_keep_s
    try:
        allowed_hosts(options.source, services.settings)
    except InputError as error:
        raise type(error)(f"{FIELD_PREFIX}.{error.field}", error.problem, error.remedy) from None
    if options.keep_s <= most_s:
        return options
    if "keep_s" not in options.model_fields_set:
        return options.model_copy(update={"keep_s": most_s})
    problem = f"{options.keep_s:g} is longer than the {most_s:g} seconds that a feed's past is stored here."
    raise InputError(f"{FIELD_PREFIX}.keep_s", problem, f"Ask for {most_s:g} or less, or leave it out.")


def _calibration(services: Deps, feed_id: str, received: Received) -> tuple[str, str]:
    """The text of the calibration that came in, and its name.

    Raises:
        InputError: there is none, or it is no calibration. Some formats only the worker reads: then the feed says so.
    """
    name = received.names.get(CALIBRATION_PART)
    if name is None:
        raise InputError(CALIBRATION_PART, "a feed needs the calibration of its endoscope.", FEED_FORM.remedy)
    path = services.store.incoming_folder(feed_id) / name
    check_file(path, CALIBRATION_PART, services.settings.clip_limits)
    text = decoded_text(path.read_bytes())
    assert text is not None  # check_file() has read it
    return text, name


async def _wish(services: Deps, caller: Caller, feed_id: str, wish: FeedWish, action: AuditAction) -> FeedRecord:
    """Wish something of the caller's feed. Returns its record before."""
    caller.require(KeyScope.FEEDS)

    def wished() -> FeedRecord:
        before = owned_feed(services, caller, feed_id)
        services.audit.record(action, caller, feed_id)
        services.queue.wish_feed(feed_id, wish)
        return before

    return await run_in_threadpool(wished)


async def _when(
    services: Deps, response: Response, feed_id: str, caller: Caller, is_so: Callable[[FeedView], bool]
) -> FeedView:
    """The feed when its worker reports that it is so; else as it is after FOLLOWED_WITHIN_S, and the status is 202."""
    until_s = time.monotonic() + FOLLOWED_WITHIN_S
    while True:
        view = _view(await run_in_threadpool(owned_feed, services, caller, feed_id))
        if is_so(view):
            return view
        if time.monotonic() > until_s:
            response.status_code = 202
            return view
        await asyncio.sleep(LOOK_PERIOD_S)


def _is_read(feed: FeedView) -> bool:
    """Whether a worker follows the feed and has not paused it."""
    return feed.state is not FeedState.PAUSED and feed.reason is not FeedReason.NO_WORKER


def _view(record: FeedRecord) -> FeedView:
    return FeedView.of(record, time.time())
