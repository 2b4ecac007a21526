"""The routes of live feeds: the methods of both clients, written once as in core.py."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import httpx
from pydantic import TypeAdapter
from typing_extensions import Unpack

from intrasplat_client import submission
from intrasplat_client.connection import Call
from intrasplat_client.models import CutRange, FeedReceipt, FeedView, GivenOptions, JobView
from intrasplat_client.session import Session, parsed


class CutJob(JobView):
    """The job of a part of a feed's recording, and what that part holds."""

    cut: CutRange


class FeedCalls:
    """The methods. A feed's id is a `scene` for render, render_array, recorded, measure, export and stream."""

    _session: Session

    async def open_feed(
        self,
        calibration: Path,
        source: str | None = None,
        *,
        layout: Literal["auto", "sbs", "tb", "two"] | None = None,
        label: str | None = None,
        keep_s: float | None = None,
        width: int | None = None,
        camera: Literal["fixed", "moving"] | None = None,
        idempotency_key: str | None = None,
    ) -> FeedView:
        """Open a live feed, which the service follows from now on.

        source: an rtsp://, tcp://, udp:// or http:// URL, a file or a device that the service allows; None: the video
            is pushed to feed.links["video"] or, picture by picture, to feed.links["pictures"].
        layout: how two eyes arrive; auto finds it. keep_s: seconds of the past that can be viewed and cut out.
        width: of the pictures that the model learns; None: what the machine keeps up with.
        camera: moving, if the endoscope's motion is to be separated from the tissue's.
        label: a text to find the feed by; write no names of persons into it.
        idempotency_key: the same key with the same options and calibration is the same feed.

        Raises:
            InputError: the calibration cannot be read; nothing was sent.
        """
        given = {"source": source, "layout": layout, "label": label, "keep_s": keep_s, "width": width, "camera": camera}
        options = {name: value for name, value in given.items() if value is not None}
        prepared = submission.prepare_feed(Path(calibration), options, idempotency_key)
        return _view(await self._session.request(submission.form_call(prepared)))

    async def feeds(self) -> list[FeedView]:
        """The open feeds, newest first."""
        response = await self._session.request(Call("GET", "/feeds", is_repeatable=True))
        return parsed(response, TypeAdapter(list[FeedView]).validate_json, response.content)

    async def feed(self, feed_id: str) -> FeedView:
        """A feed's state, with its reason and numbers."""
        return _view(await self._session.request(Call("GET", _path(feed_id), is_repeatable=True)))

    async def pause_feed(self, feed_id: str) -> FeedView:
        """Stop reading, recording and learning; the past stays. Its state is "paused" when its worker has stopped."""
        return _view(await self._session.request(Call("POST", _path(feed_id, "pause"), is_repeatable=True)))

    async def resume_feed(self, feed_id: str) -> FeedView:
        """Go on after a pause."""
        return _view(await self._session.request(Call("POST", _path(feed_id, "resume"), is_repeatable=True)))

    async def cut_feed(
        self,
        /,
        feed_id: str,
        start: float | str,
        end: float | str = "live",
        *,
        label: str | None = None,
        metadata: Mapping[str, str] | None = None,
        callback_url: str | None = None,
        idempotency_key: str | None = None,
        **options: Unpack[GivenOptions],
    ) -> CutJob:
        """Make a job of a part of the recording; job.cut is its exact range.

        start, end: live, seconds before that (-30), seconds of the source, or a time of RFC 3339. Other arguments as
        reconstruct has them.

        Raises:
            InputError: an option cannot be used; nothing was sent.
        """
        document = {"from": start, "to": end, "options": submission.checked_options(options)}
        document |= submission.labels_of(label, metadata) | submission.texts_of(callback_url=callback_url)
        headers = {} if idempotency_key is None else {"Idempotency-Key": idempotency_key}
        response = await self._session.request(Call("POST", _path(feed_id, "cut"), headers=headers, json=document))
        return parsed(response, CutJob.model_validate_json, response.content)

    async def end_feed(self, feed_id: str) -> FeedReceipt:
        """End a feed and delete all that belongs to it; jobs of its cuts stay. The receipt says what was done."""
        response = await self._session.request(Call("DELETE", _path(feed_id)))
        return parsed(response, FeedReceipt.model_validate_json, response.content)


def _view(response: httpx.Response) -> FeedView:
    return parsed(response, FeedView.model_validate_json, response.content)


def _path(*parts: str) -> str:
    return "".join(f"/{quote(part, safe='')}" for part in ("feeds", *parts))
