"""Draws docs/images/dashboard.png: the page with a scene of synthetic tissue that the real service has just trained.

python -m tests.client.draw_dashboard
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from selenium.webdriver.support.ui import WebDriverWait

from lab.demo import started_service, zipped
from tests.client.page import LOOK_S, Page, browser

OUT = Path(__file__).resolve().parents[2] / "docs" / "images" / "dashboard.png"
PHANTOM = ("--motion", "pull", "--frames", "48", "--width", "320", "--height", "256", "--seed", "3")
BUDGET_S = 15
TRAINED_WITHIN_S = 300.0
SHOWN_FRAME = 19
COLOURS = 256
JUDGED = "return document.querySelector('#report .light:not(.pending)') !== null"
CURVE = "return document.querySelector('#curve polyline.score')?.points ?? []"


def main() -> None:
    """Train, look, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=OUT, help="the picture (default: %(default)s)")
    parser.add_argument("--training", type=Path, help="also draw the page while it trains")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="intrasplat-page-") as name:
        folder = Path(name)
        command = [sys.executable, "-m", "lab", "phantom", *PHANTOM]
        subprocess.run([*command, "--format", "stereomis", "--out", str(folder / "clip")], check=True)
        clip = zipped(folder / "clip")
        with started_service(folder / "data", folder / "service.log") as client, browser() as driver:
            page = Page(driver, client.url)
            draw(page, clip, options.out, options.training)


def draw(page: Page, clip: Path, out: Path, training: Path | None) -> None:
    """Send the clip by the page's form, wait for the scene, and take the page's picture."""
    page.driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    )
    page.open()
    page.choose("clip", clip)
    page.script(f"document.querySelector('[name=budget_s]').value = {BUDGET_S}")
    page.click("#upload [type=submit]")
    wait = WebDriverWait(page.driver, TRAINED_WITHIN_S, LOOK_S)
    if training is not None:
        wait.until(lambda _: page.state == "training" and len(page.script(CURVE)) > 1)
        save(page, training)
    wait.until(lambda _: page.script(JUDGED))
    page.script(
        "const frame = arguments[0]; import(document.scripts[0].src).then(({ viewer }) => viewer.timeline.goTo(frame))",
        SHOWN_FRAME,
    )
    wait.until(lambda _: page.state == "live" and f"frame {SHOWN_FRAME + 1} " in page.text("#time-value"))
    save(page, out)


def save(page: Page, path: Path) -> None:
    """The page as it looks, in COLOURS colours: a third of the bytes."""
    with Image.open(io.BytesIO(page.driver.get_screenshot_as_png())) as picture:
        picture.convert("RGB").quantize(COLOURS).save(path, optimize=True)


if __name__ == "__main__":
    main()
