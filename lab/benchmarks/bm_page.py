"""How soon is the page there, what does it ask for, and what does it show over a slow line?

    python -m lab.benchmarks.bm_page [--visits 3] [--rest-s 30] [--moving-s 15]

Headless Chromium opens a page with one finished scene: visits without and with a cache, with milliseconds to the
first paint and until the first picture was noticed, requests and bytes; visits without a cache by a shared link, with
milliseconds until its first picture and until it plays and rocks; then requests, messages over the WebSocket and
bytes at rest; then pictures a second while the clip plays over a line of 400 kbit/s and 400 ms. A stand-in for a worker
sends pictures that are as hard to code as tissue, so that no figure depends on a renderer. Bytes of requests are of
answers with their heads.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from statistics import median

from intrasplat.commands.arguments import count, positive
from tests.client.page import Page, Site, browser, site_at
from tests.client.slow_line import slow_line
from tests.client.tissue import BIT_PER_S, LATENCY_S, WATCH, TissuePainter
from tests.client.words import say

SETTLED_S = 3.0
COUNT = """
const paint = performance.getEntriesByName("first-contentful-paint")[0]?.startTime ?? -1;
const sent = ["navigation", "resource"].slice(arguments[0] ? 0 : 1)
  .flatMap((kind) => performance.getEntriesByType(kind)).filter((each) => each.transferSize > 0);
return [paint, performance.now(), sent.length, sent.reduce((sum, each) => sum + each.transferSize, 0)];
"""
"""Milliseconds to the first paint, -1 without one, and until now; requests to the service, without that for the page if
the argument is false, and bytes of their answers."""

NOTES = """
window.firstMs = window.movesMs = 0;
window.came = [];
setInterval(() => {
  const get = (id) => document.getElementById(id);
  const [first, picture] = [get("first"), get("picture")];
  if (!firstMs && [first, picture].some((each) => each?.hidden === false)) firstMs = performance.now();
  const isRocking = picture?.ariaLabel.includes(ROCKING);
  if (!movesMs && isRocking && get("play").ariaPressed === "true") movesMs = performance.now();
}, 5);
const Plain = WebSocket;
window.WebSocket = class extends Plain {
  constructor(...given) {
    super(...given);
    this.addEventListener("message", ({ data }) => came.push(data.byteLength ?? data.length));
  }
};
"""
"""Notes when the first picture is there, when the page plays and shows one from where ROCKING says, and the bytes of
messages over a WebSocket."""


def main() -> None:
    """Print a line for each kind of visit, for rest, and for the slow line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--visits", type=count, default=3, help="of each kind (default: %(default)s)")
    parser.add_argument("--rest-s", type=positive, default=30.0, help="seconds at rest (default: %(default)s)")
    parser.add_argument("--moving-s", type=positive, default=15.0, help="over the slow line (default: %(default)s)")
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    with (
        tempfile.TemporaryDirectory(prefix="intrasplat-page-") as name,
        site_at(Path(name) / "data", TissuePainter().answer) as site,
        browser() as driver,
    ):
        scene = site.scene()
        page = Page(driver, site.url)
        _visit(site, page)  # the browser starts
        for kind in ("cold", "warm"):
            visits = [_visit(site, page, is_cold=kind == "cold") for _ in range(options.visits)]
            paint_ms, picture_ms, requests, sent_bytes = (median(each) for each in zip(*visits, strict=True))
            print(
                f"{kind}: first paint {paint_ms:.0f} ms (at most {max(each[0] for each in visits):.0f}), picture "
                f"{picture_ms:.0f} ms, {requests:.0f} requests, {sent_bytes / 1e3:.1f} kB",
                flush=True,
            )
        source = NOTES.replace("ROCKING", json.dumps(say("live.rocking")))
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": source})
        _shared(site, page, scene, options.visits)
        _rest(site, page, options.rest_s)
        _slow(site, page, options.moving_s)
        driver.get("about:blank")  # or its connections keep the service from ending


def _visit(site: Site, page: Page, *, is_cold: bool = False) -> tuple[float, float, float, float]:
    """What COUNT finds when the first picture is there."""
    site.announce()  # else the worker counts as gone after a while
    page.driver.get("about:blank")
    if is_cold:
        page.driver.execute_cdp_cmd("Network.clearBrowserCache", {})
    page.open()
    page.until_state("live")
    paint_ms, now_ms, requests, sent_bytes = page.script(COUNT, True)
    return paint_ms, now_ms, requests, sent_bytes


def _shared(site: Site, page: Page, scene: str, visits: int) -> None:
    seen = []
    for _ in range(visits):
        site.announce()
        page.driver.get("about:blank")
        page.driver.execute_cdp_cmd("Network.clearBrowserCache", {})
        page.driver.get(f"{site.url}/#/scene/{scene}?play=1&rock=1")
        page.until(lambda: page.script("return movesMs"))
        seen.append(page.script("return [firstMs, movesMs]"))
    first_ms, moves_ms = (median(each) for each in zip(*seen, strict=True))
    most = max(each[1] for each in seen)
    print(f"shared link: picture {first_ms:.0f} ms, plays and rocks {moves_ms:.0f} ms (at most {most:.0f})", flush=True)


def _rest(site: Site, page: Page, rest_s: float) -> None:
    page.driver.get("about:blank")
    page.open()
    page.until_state("live")
    _wait(site, SETTLED_S)
    page.script("performance.setResourceTimingBufferSize(10000); performance.clearResourceTimings(); came.length = 0")
    _wait(site, rest_s)
    requests, sent_bytes = page.script(COUNT, False)[2:]
    messages = page.script("return came")
    print(
        f"at rest, {rest_s:g} s: {requests} requests, {sent_bytes / 1e3:.2f} kB; {len(messages)} messages, "
        f"{sum(messages) / 1e3:.2f} kB",
        flush=True,
    )


def _slow(site: Site, page: Page, moving_s: float) -> None:
    with slow_line(int(site.url.rpartition(":")[2]), BIT_PER_S, LATENCY_S) as port:
        slow = Page(page.driver, f"http://127.0.0.1:{port}")
        slow.open()
        slow.until(lambda: not slow.script("return document.querySelector('#play').disabled"))
        slow.script(WATCH)
        slow.click("#play")
        _wait(site, moving_s)
        pictures = slow.script("return pictures")
        seconds = pictures[-1][0] - pictures[0][0] if len(pictures) > 1 else 0.0
        rate_hz = (len(pictures) - 1) / seconds if seconds else 0.0
        line = f"{BIT_PER_S / 1e3:g} kbit/s, {1000 * LATENCY_S:g} ms"
        print(
            f"{line}: {rate_hz:.1f} pictures a second in {seconds:.1f} s, {pictures[-1][1] if pictures else 0} px wide"
        )
        slow.driver.get("about:blank")


def _wait(site: Site, seconds: float) -> None:
    """Wait, while the worker lives."""
    until_s = time.monotonic() + seconds
    while (left_s := until_s - time.monotonic()) > 0:
        site.announce()
        time.sleep(min(1.0, left_s))


if __name__ == "__main__":
    main()
