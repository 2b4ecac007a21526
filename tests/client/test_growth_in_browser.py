"""What grows while the page is used for hours: pictures, listeners and what it remembers of jobs."""

from __future__ import annotations

from tests.client.page import Page, Site
from tests.client.words import say

COUNT = """
window.counts = { bitmaps: 0, listeners: 0, sizes: 0, pictures: 0 };
const create = window.createImageBitmap.bind(window), close = ImageBitmap.prototype.close;
const open = new WeakSet();
window.createImageBitmap = async (...given) => {
  const bitmap = await create(...given);
  open.add(bitmap);
  counts.bitmaps += 1;
  counts.pictures += 1;
  return bitmap;
};
ImageBitmap.prototype.close = function () {
  if (open.delete(this)) counts.bitmaps -= 1;
  close.call(this);
};
const { addEventListener: add, removeEventListener: remove } = EventTarget.prototype;
AbortSignal.prototype.addEventListener = function (...given) {
  counts.listeners += 1;
  return add.apply(this, given);
};
AbortSignal.prototype.removeEventListener = function (...given) {
  counts.listeners -= 1;
  return remove.apply(this, given);
};
const size = Object.getOwnPropertyDescriptor(HTMLCanvasElement.prototype, "width");
Object.defineProperty(HTMLCanvasElement.prototype, "width", {
  get: size.get,
  set(value) {
    if (this.id === "picture") counts.sizes += 1;
    size.set.call(this, value);
  },
});
"""
MAPS = """
const done = arguments[0];
import(new URL("library/jobs.js", document.scripts[0].src)).then(async ({ Jobs }) => {
  const jobs = new Jobs(() => {}, () => {}, () => true);
  window.known = () => [jobs.byId.size, jobs.scores.size, jobs.told.size, jobs.followed.size];
  done();
});
"""
PICTURES = 40


def test_row_12_pictures_are_closed_the_canvas_keeps_its_size_and_listeners_do_not_pile_up(
    site: Site, page: Page
) -> None:
    script = page.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": COUNT})
    try:
        page.open()
        page.press(site.scene(), "View")
        page.until_state("live")
        page.click("#play")
        page.until(lambda: page.script("return counts.pictures") > 5)
        before = page.script("return { ...counts }")
        page.until(lambda: page.script("return counts.pictures") > before["pictures"] + PICTURES)
        after = page.script("return { ...counts }")
        page.click("#play")
        assert after["bitmaps"] <= 2  # one under way, one about to be shown
        assert after["sizes"] == before["sizes"]
        assert after["listeners"] <= before["listeners"] + 3
    finally:
        page.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)


def test_row_12_jobs_that_are_gone_are_forgotten(site: Site, page: Page) -> None:
    kept = site.scene()  # before anybody follows it, or its own events are known, too
    page.driver.execute_async_script(MAPS)
    for _ in range(4):
        job_id = site.queued_job()
        claim = site.claim()
        site.train(claim, 20, 24.0)
        page.until(lambda: page.script("return known()")[2] == 1)  # its events have told of it
        site.finish(claim)
        site.queue.forget(job_id)
        site.store.purge(job_id)
        page.until(lambda: page.script("return known()") == [1, 1, 0, 0])
    page.until(lambda: page.script("return document.querySelectorAll('#jobs li').length") == 1)
    page.until_text(f'[data-job="{kept}"]', say("job.view"))
