"""Answers from a live feed, without a feed: its moments are made up."""

from __future__ import annotations

import gc
import secrets
import time
import weakref
from types import SimpleNamespace
from typing import Any

import pytest

from contract.wire.rendering import ExportRequest
from intrasplat.errors import InputError
from intrasplat.live.looking import FeedMoment
from intrasplat.live.state import FeedState
from intrasplat.live.times import FeedTime
from tests.intrasplat.scenes import random_scene
from worker.feed_views import FeedViews

FEED_ID = "0" * 32


def views_of_new_scenes(scenes: list[weakref.ref[Any]]) -> FeedViews:
    """Answers from a feed of which every look shows a new scene, to which `scenes` gets a weak reference."""

    def moment(when: FeedTime) -> FeedMoment:
        scene = random_scene()
        scenes.append(weakref.ref(scene))
        return FeedMoment(scene, 0.0, 1.0, time.time(), 0.0, is_live=True, is_stale=False)

    hosted = SimpleNamespace(feed_id=FEED_ID, state=FeedState.LIVE, feed=SimpleNamespace(moment=moment))
    return FeedViews(hosted)  # type: ignore[arg-type]


def export(**more: object) -> ExportRequest:
    given = {"scene_id": FEED_ID, "attempt": 0, "export_id": secrets.token_hex(16)} | more
    return ExportRequest.model_validate(given)


def test_an_export_has_one_scene_which_is_dropped_at_its_end() -> None:
    scenes: list[weakref.ref[Any]] = []
    views, request, more = views_of_new_scenes(scenes), export(), True
    while more:
        more = views.answer(request).more
        assert not more or scenes[0]() is not None
        request = request.model_copy(update={"part": request.part + 1})
    gc.collect()
    assert [each() for each in scenes] == [None]


def test_the_scene_of_a_refused_export_is_dropped() -> None:
    scenes: list[weakref.ref[Any]] = []
    views = views_of_new_scenes(scenes)
    with pytest.raises(InputError):
        views.answer(export(format="unknown"))
    gc.collect()
    assert [each() for each in scenes] == [None]
