"""Recorded pictures of live feeds over HTTP, which viewers ask for ten times a second."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.feed_worker import FeedWorker, following
from tests.service.test_feeds import followed
from tests.service.under_test import ServiceUnderTest, running_service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[ServiceUnderTest]:
    yield from running_service(tmp_path, feed_keep_s=600.0)


@pytest.fixture
def worker(service: ServiceUnderTest) -> Iterator[FeedWorker]:
    with following(service.queue, service.store.run_dir) as worker:
        yield worker


def test_a_picture_that_has_not_changed_is_not_sent_again_and_not_logged(
    service: ServiceUnderTest, worker: FeedWorker, caplog: pytest.LogCaptureFixture
) -> None:
    feed_id = followed(service)
    path, query = f"/scenes/{feed_id}/recorded", {"t": "live", "masks": "off"}
    caplog.set_level(logging.INFO, "intrasplat.access")
    caplog.clear()
    first = service.http.get(path, params=query)
    assert (first.status_code, first.content) == (200, b"picture")
    worker.newest_s += 1
    again = service.http.get(path, params=query, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert float(again.headers["x-intrasplat-source-s"]) == 61
    assert again.headers["cache-control"] == "no-store"
    other = service.http.get(path, params=query, headers={"If-None-Match": '"another"'})
    assert (other.status_code, other.headers["etag"]) == (200, first.headers["etag"])
    assert not caplog.records
    service.http.get(path, params=query | {"t": "soon"})
    assert len(caplog.records) == 1
