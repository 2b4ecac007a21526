"""What the live screen says while something changes: nothing that is wrong for a second."""

from __future__ import annotations

from typing import Any

import pytest

from client.page import DASHBOARD
from intrasplat.live.state import FeedReason, FeedState
from tests.client.live_feed import LivePage, LivePainter, opened_feed
from tests.client.page import Site
from tests.client.test_live_in_browser import DRAG_TAPE, age_of, watched
from tests.client.test_live_in_browser import page as page
from tests.client.test_live_in_browser import painter as painter
from tests.client.words import LANGUAGES, say, table

NOTE_WORDS = """
const [id, key] = arguments;
const line = document.getElementById(id);
window[key] = [];
new MutationObserver(() => window[key].push(line.textContent)).observe(line, { childList: true, subtree: true });
"""
"""What an element says from now on."""
HEADLINES = """
const [cases] = arguments;
const picture = { pictureAtS: 100, pictureAgeS: 0.2, pictureProblem: null };
const fresh = { isGone: false, mode: "live", answerAgeS: 0, modelAgeS: 0.4, ...picture };
const feed = { state: "live", reason: null, received_fps: 30, last_frame_at_s: 100 };
return import("/live/headline.js").then(({ headlineOf }) =>
  cases.map((each) => headlineOf({ ...fresh, ...each, feed: { ...feed, ...each.feed } }).place));
"""
ALOUD = """
const [words] = arguments;
return Promise.all([import("/live/aloud.js"), import("/base/messages.js")]).then(([{ Aloud }, { setLanguage }]) => {
  const line = document.createElement("p");
  const aloud = new Aloud(line);
  try {
    return words.map(([atMs, place, text, code]) => {
      performance.now = () => atMs;
      setLanguage(code);
      aloud.note({ kind: "live", place }, text);
      return line.textContent;
    });
  } finally {
    delete performance.now;
  }
});
"""
"""What is read aloud after each of these words, which stand on top at these times."""
REFUSED = {"pictureProblem": {"status": 503}, "pictureAgeS": 2.5}
STALLED = {"state": "stalled", "reason": "undecodable"}


@pytest.mark.parametrize(
    ("known", "word"),
    [
        ({"feed": STALLED}, "unusable"),
        ({"feed": {**STALLED, "last_frame_at_s": 99.5}}, "live"),
        ({"feed": {**STALLED, "last_frame_at_s": 99.5}, "modelAgeS": 8.0}, "behind"),
        ({"feed": {**STALLED, "last_frame_at_s": 99.5}, "pictureAgeS": 3.0}, "unusable"),
        ({"feed": {**STALLED, "reason": "no_scene"}}, "no_model"),
        ({**REFUSED, "feed": {"last_frame_at_s": 102.4}}, "picture_behind"),
        ({**REFUSED, "feed": {"last_frame_at_s": 104.9}, "pictureAgeS": 5.0}, "no_picture"),
        (REFUSED, "no_picture"),
    ],
)
def test_no_word_is_said_for_a_second_where_a_report_is_late(
    site: Site, page: LivePage, known: dict[str, Any], word: str
) -> None:
    assert page.script(HEADLINES, [known]) == [f"live.word_{word}"]


def test_every_state_and_reason_has_words() -> None:
    for language in LANGUAGES:
        places = set(table(language)["live"])
        assert {f"reason_{reason.value}" for reason in FeedReason} == {each for each in places if "reason_" in each}
        assert {f"state_{state.value}" for state in FeedState} == {each for each in places if "state_" in each}
    source = (DASHBOARD / "live" / "headline.js").read_text()
    assert all(f"{state.value}:" in source for state in FeedState if state not in (FeedState.LIVE, FeedState.BEHIND))


def test_the_word_is_read_aloud_as_it_comes_to_rest(site: Site, page: LivePage, painter: LivePainter) -> None:
    watched(site, page)
    aloud = "return document.getElementById('word-aloud').textContent"
    page.until(lambda: page.script(aloud) == say("live.word_live"))
    page.script(NOTE_WORDS, "word-aloud", "said")
    page.script(DRAG_TAPE, -1, -3, -5)
    page.until(lambda: page.script(aloud) == say("live.word_back", s=5))
    page.click("#live")
    page.until(lambda: page.script(aloud) == say("live.word_live"))
    painter.model_lag_s = 3.3
    page.until(lambda: page.script(aloud).startswith("MODEL BEHIND"))
    painter.model_lag_s = 6.3
    page.until(lambda: page.script(aloud) == "")
    said = [text for text in page.script("return window.said") if text]
    assert [text.rstrip("0123456789 s") for text in said] == ["LOOKING BACK", "LIVE", "MODEL BEHIND"]


def test_a_word_is_read_aloud_again_after_another_one_and_in_another_language(site: Site, page: LivePage) -> None:
    shown = [
        (0, "live", "LIVE", "en", ""),
        (800, "live", "LIVE", "en", "LIVE"),
        (1000, "behind", "BEHIND 3 s", "en", ""),
        (1300, "live", "LIVE", "en", ""),
        (2100, "live", "LIVE", "en", "LIVE"),
        (3000, "live", "JETZT", "de", ""),
        (3800, "live", "JETZT", "de", "JETZT"),
        (4000, "behind", "BEHIND 3 s", "en", ""),
        (4800, "behind", "BEHIND 3 s", "en", "BEHIND 3 s"),
        (5000, "behind", "BEHIND 4 s", "en", ""),
        (5800, "behind", "BEHIND 4 s", "en", ""),
    ]
    assert page.script(ALOUD, [each[:4] for each in shown]) == [said for *_, said in shown]


def test_a_model_that_is_there_is_said_to_be_loaded(site: Site, page: LivePage, painter: LivePainter) -> None:
    painter.answer_after_s = 2.0
    page.watch(opened_feed(site))
    page.until_text("#model-message", say("live.model_loads"))
    painter.answer_after_s, painter.has_model = 0.0, False
    page.watch(opened_feed(site))
    page.until_text("#model-message", say("live.no_model"))


def test_a_frozen_picture_s_age_is_not_said_of_the_model_that_goes_on(
    site: Site, page: LivePage, painter: LivePainter
) -> None:
    watched(site, page)
    page.script(DRAG_TAPE, -20)
    page.until(lambda: page.state == "back" and (age_of(page, "model") or {"ageMs": 0})["ageMs"] > 19_000)
    page.script(NOTE_WORDS, "word", "said")
    painter.answer_after_s = 0.3
    page.click("#live")
    page.until(lambda: (age_of(page, "model") or {"ageMs": 9999})["ageMs"] < 2000)
    assert say("live.word_live") in (said := page.script("return window.said"))
    assert [text for text in said if text.startswith("MODEL BEHIND")] == []
