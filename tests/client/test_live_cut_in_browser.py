"""The button of the live screen that makes a clip of the last seconds."""

from __future__ import annotations

import pytest

from contract.runtime.settings import Settings
from contract.wire.job import JobState
from intrasplat.errors import InputError, LimitError
from tests.client import live_feed
from tests.client.live_feed import LivePage, LivePainter
from tests.client.page import Site
from tests.client.test_live_in_browser import page as page
from tests.client.test_live_in_browser import painter as painter
from tests.client.test_live_in_browser import watched
from tests.client.words import say

NOTE_CUTS = """
const [lost] = arguments;
const ask = window.fetch;
window.cuts = [];
window.fetch = (path, options) => {
  if (path === lost) return Promise.reject(new TypeError("lost"));
  if (path.endsWith("/cut")) window.cuts.push(JSON.parse(options.body));
  return ask(path, options);
};
"""
"""Note the parts that the page asks for from now on; no answer comes from the path `lost`."""


def test_the_last_30_s_become_a_job_and_its_state_is_shown(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page, "liver")
    page.click("#keep")
    page.until_text("#kept", say("live.kept_open"))
    (job,) = site.queue.records()
    assert page.script("return document.querySelector('#kept a').hash") == f"#/scene/{job.job_id}"
    asked = f"import('/base/api.js').then(({{ getJob }}) => getJob('{job.job_id}'))"
    label = page.script(f"return {asked}.then(({{ label }}) => label)")
    assert label.startswith("liver")
    assert job.state is JobState.QUEUED
    page.until_text("#kept", say("state.queued"))
    claim = site.claim()
    site.train(claim, 40, 28.0)
    page.until_text("#kept", say("stage.train"))
    site.finish(claim)
    page.until_text("#kept", say("state.done"))


@pytest.mark.parametrize(
    ("fps", "lost", "length_s"), [(30.0, None, 30.0), (50.0, None, 17.0), (500.0, None, 1.0), (50.0, "/info", 30.0)]
)
def test_no_longer_part_is_asked_for_than_a_clip_may_have_frames(
    site: Site,
    page: LivePage,
    painter: LivePainter,
    monkeypatch: pytest.MonkeyPatch,
    fps: float,
    lost: str | None,
    length_s: float,
) -> None:
    assert Settings().max_frames == 1000
    monkeypatch.setattr(live_feed, "FPS", fps)
    watched(site, page)
    page.script(NOTE_CUTS, lost)
    page.click("#keep")
    page.until_text("#kept", say("live.kept_open"))
    (cut,) = page.script("return window.cuts")
    assert (cut["from"], cut["to"]) == (-length_s, "live")


@pytest.mark.parametrize("refusal", [InputError, LimitError])
def test_a_part_that_is_refused_says_why_and_which_part_is_possible(
    site: Site, page: LivePage, painter: LivePainter, refusal: type[InputError]
) -> None:
    watched(site, page)
    why, remedy = "The part has 1476 frames; a clip may have 1000.", "Ask for at most 20 s."
    painter.refuses_cuts = refusal("from", "t" + why[1:], remedy)
    page.click("#keep")
    page.until_text("#kept", f"{say('live.kept_failed', why='').strip()} {why} {remedy}")
    painter.refuses_cuts = None
    page.click("#keep")
    page.until_text("#kept", say("live.kept_open"))
    assert remedy not in page.text("#kept")
