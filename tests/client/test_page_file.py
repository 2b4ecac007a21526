"""One HTML file with player and scene: it opens from a disk, asks for nothing, and shows what a worker renders."""

from __future__ import annotations

import base64
import dataclasses
import http.server
import re
import threading
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from client.page import DASHBOARD
from intrasplat.__main__ import main
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import InputError, SceneError, UnavailableError
from intrasplat.names import DETAIL, RECORDED, REPORT
from intrasplat.report import DetailScores
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.inline import CannotInlineError, inlined, joined
from intrasplat.scene.recorded_file import name_of
from intrasplat.scene.scene import TrainedScene
from intrasplat.scene.stored_exports import DASHBOARD_VARIABLE, stored_parts
from intrasplat.scene.training_pictures import pictures_of
from intrasplat.view.render import render_frame
from intrasplat.view.unseen import hatched
from tests.archives import ORIGIN, report_of, small_scene, stored
from tests.client.page import browser
from tests.client.player import drawing_browser
from tests.client.test_accessible_in_browser import RUN
from tests.client.test_accessible_in_browser import axe as axe
from tests.client.test_player import LEAST_DB as DETAIL_DB
from tests.client.test_player import scattered
from tests.client.test_player_detail import SIZE
from tests.client.test_player_detail import stored as with_recorded_frames
from tests.client.words import say, table
from tests.intrasplat.scenes import random_scene

LEAST_DB = 50.0
OPENS_WITHIN_S = 120.0
TABLE = table("en")["file"]
STATE = "return document.body.dataset.state ?? ''"
RESTS = """
const done = arguments[0];
const seen = () => document.getElementById("picture").toDataURL("image/png");
let before = "";
const look = () => {
  const now = seen();
  if (now === before) done({ picture: now, notices: document.getElementById("notices").textContent });
  else { before = now; setTimeout(look, 1500); }
};
setTimeout(look, 1500);
"""
"""The picture, once it has not changed for longer than it rests and is drawn anew."""


@pytest.fixture(scope="module")
def scene() -> TrainedScene:
    return scattered(14, moves=True)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory, scene: TrainedScene) -> Path:
    folder = tmp_path_factory.mktemp("page")
    path = folder / "scene.html"
    path.write_bytes(b"".join(stored_parts("html", stored(folder / "scene", scene), ORIGIN, DASHBOARD)))
    return path


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    with drawing_browser() as driver:
        driver.set_script_timeout(OPENS_WITHIN_S)
        driver.execute_cdp_cmd("Emulation.setLocaleOverride", {"locale": "en-GB"})
        yield driver


def opened(driver: webdriver.Chrome, path: Path, state: str, view: str = "") -> None:
    driver.get("about:blank")
    driver.get_log("browser")
    driver.get(f"{path.as_uri()}{view}")
    WebDriverWait(driver, OPENS_WITHIN_S).until(lambda _: driver.execute_script(STATE) == state)


def shown(driver: webdriver.Chrome) -> tuple[NDArray[np.uint8], str]:
    """The picture at rest, RGB, and the notices below it."""
    answer = driver.execute_async_script(RESTS)
    return png_of(answer["picture"]), answer["notices"]


def png_of(address: str) -> NDArray[np.uint8]:
    """[H, W, 3] RGB of a picture in a data: address."""
    encoded = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR)[..., ::-1], np.uint8)


def text(driver: webdriver.Chrome, css: str) -> str:
    return str(driver.find_element(By.CSS_SELECTOR, css).get_property("textContent"))


def psnr_db(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((first.astype(float) - second) ** 2), 1e-9)))


def test_the_file_opens_from_a_disk_and_shows_what_a_worker_renders(
    driver: webdriver.Chrome, file: Path, scene: TrainedScene
) -> None:
    player = scene.units_per_mm
    for view, t, orbit in (("", 0.0, None), ("#t=0.5&orbit=12,-7,1.5", 0.5, (12.0, -7.0, 1.5))):
        opened(driver, file, "shown", view)
        picture, notices = shown(driver)
        camera = scene.intrinsics.resized(picture.shape[1], picture.shape[0])
        pose = None if orbit is None else orbit_pose(*orbit, 60 / player)
        frame = render_frame(load_scene(file.parent / "scene"), t, pose, camera)
        expected = hatched(frame.rgb, frame.unseen)
        assert expected.std() > 10
        assert psnr_db(picture, expected) >= LEAST_DB
        assert bool(notices) == bool(frame.warnings)
        assert driver.get_log("browser") == []
    asked = driver.execute_script("return performance.getEntriesByType('resource').map((each) => each.name)")
    assert [each for each in asked if not each.startswith("blob:")] == []


def orbit_pose(yaw_deg: float, pitch_deg: float, zoom: float, depth_mm: float) -> NDArray[np.float64]:
    """As intrasplat/pose.py defines an orbit about the point at the median depth."""
    yaw, pitch = np.radians([-yaw_deg, -pitch_deg])
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    pose = np.eye(4)
    pose[:3, :3] = about_y @ about_x
    pose[:3, 3] = np.array([0, 0, depth_mm]) - pose[:3, :3] @ np.array([0, 0, depth_mm / zoom])
    return pose


def test_its_controls_move_time_and_camera_and_say_what_is_shown(driver: webdriver.Chrome, file: Path) -> None:
    opened(driver, file, "shown")
    first, _ = shown(driver)
    assert text(driver, "#research") == TABLE["research"]
    assert driver.find_element(By.ID, "verdict").text.endswith(say("light.care"))  # nothing is open
    facts = text(driver, "#facts")
    assert ORIGIN in facts
    assert "700" in facts
    assert say("figure.likeness_beside_copies", db="36.20 dB", best="30.00 dB") in facts
    assert text(driver, "#warnings li small") == "<img src=x onerror=alert(1)> Smith & Sons"
    assert driver.find_elements(By.CSS_SELECTOR, "img") == []
    driver.execute_script(
        "const t = arguments[0]; t.value = '0.6'; t.dispatchEvent(new Event('input'))",
        driver.find_element(By.ID, "time"),
    )
    later, _ = shown(driver)
    assert psnr_db(first, later) < 40
    assert text(driver, "#seconds") == TABLE["seconds"].format(now="0.12", all="0.17")
    driver.find_element(By.ID, "stage").send_keys("\ue012\ue012+")  # two times to the left, nearer
    turned, _ = shown(driver)
    assert psnr_db(later, turned) < 40
    driver.find_element(By.ID, "home").click()
    assert psnr_db(shown(driver)[0], later) > LEAST_DB
    driver.find_element(By.ID, "play").click()
    assert driver.find_element(By.ID, "play").get_attribute("aria-pressed") == "true"
    WebDriverWait(driver, OPENS_WITHIN_S).until(lambda _: not text(driver, "#seconds").startswith("0.12"))
    driver.find_element(By.ID, "play").click()
    driver.find_element(By.ID, "home").click()
    driver.execute_script(
        "const t = arguments[0]; t.value = '0.6'; t.dispatchEvent(new Event('input'))",
        driver.find_element(By.ID, "time"),
    )
    driver.find_element(By.ID, "marked").click()
    assert psnr_db(shown(driver)[0], later) < 40  # guesses instead of the hatch
    assert driver.get_log("browser") == []


HELD_OUT, SHADE = 1, 90
RECORDED_PICTURE = "return document.getElementById('recorded').toDataURL('image/png')"
HAS_DETAIL = "return document.getElementById('picture').hasAttribute('data-detail')"


def scene_with_recorded_frames(folder: Path) -> TrainedScene:
    """Its video has the training frames of both eyes, its zip their masks and a grey frame that was held out."""
    model = dataclasses.replace(scattered(14, moves=True), trained_t=(0.0, 1 / 3, 2 / 3))
    scene = with_recorded_frames(folder, model, eyes=2)
    grey = cv2.imencode(".jpg", np.full((*SIZE[::-1], 3), SHADE, np.uint8))[1].tobytes()
    with zipfile.ZipFile(folder / RECORDED, "a") as archive:
        for eye in ("left", "right"):
            archive.writestr(name_of(eye, HELD_OUT, "jpg"), grey)
    return scene


def recorded_picture(driver: webdriver.Chrome) -> NDArray[np.uint8]:
    """The recorded frame that is shown, RGB."""
    return png_of(driver.execute_script(RECORDED_PICTURE))


def test_it_has_the_recorded_frames_as_detail_and_beside_the_model(
    driver: webdriver.Chrome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, path = tmp_path / "scene", tmp_path / "scene.html"
    scene = scene_with_recorded_frames(folder)
    monkeypatch.setenv(DASHBOARD_VARIABLE, str(DASHBOARD))
    report = report_of(scene, detail=DetailScores(psnr_tissue_db=38.1, psnr_right_db=None, ssim=None))
    (folder / REPORT).write_text(report.model_dump_json())
    assert main(["export", str(folder), "--format", "html"]) == ExitCode.OK
    first = scene.trained_frames[1]
    opened(driver, path, "shown", f"#t={first / scene.frame_count}&compare=wipe")
    wait = WebDriverWait(driver, OPENS_WITHIN_S)
    wait.until(lambda _: driver.execute_script(HAS_DETAIL))
    drawn, _ = shown(driver)
    camera = scene.intrinsics.resized(drawn.shape[1], drawn.shape[0])
    frame = render_frame(load_scene(folder), first / scene.frame_count, None, camera)
    assert psnr_db(drawn, hatched(frame.rgb, frame.unseen)) >= DETAIL_DB

    expected, tissue = pictures_of(folder).picture(0, first)
    assert text(driver, "#of-recorded") == say("compare.recorded", frame=first + 1)
    assert text(driver, "#of-model") == say("compare.model")
    assert psnr_db(recorded_picture(driver), expected) > 40
    driver.find_element(By.ID, "tools").click()
    hatch = recorded_picture(driver)
    assert hatch[~tissue].max() < 80
    np.testing.assert_allclose(hatch[tissue].astype(int), expected[tissue], atol=8)
    seam, box = driver.find_element(By.ID, "seam"), driver.find_element(By.ID, "fitted")
    drag = ActionChains(driver, 0).move_to_element(seam).click_and_hold()
    drag.move_by_offset(round(0.25 * box.size["width"]), 0).release().perform()
    assert abs(int(seam.get_attribute("aria-valuenow") or 0) - 75) <= 1
    seam.send_keys(Keys.END)
    assert seam.get_attribute("aria-valuenow") == "100"

    at = "const t = arguments[0]; t.value = arguments[1]; t.dispatchEvent(new Event('input'))"
    driver.execute_script(at, driver.find_element(By.ID, "time"), str(HELD_OUT / scene.frame_count))
    wait.until(lambda _: text(driver, "#of-recorded") == say("compare.recorded", frame=HELD_OUT + 1))
    assert abs(int(np.median(recorded_picture(driver))) - SHADE) <= 2
    driver.find_element(By.ID, "stage").send_keys("\ue012")  # to the left
    wait.until(lambda _: text(driver, "#message") == say("compare.turned"))
    assert not driver.find_element(By.ID, "compare-box").is_displayed()
    driver.find_element(By.ID, "compare").click()
    wait.until(lambda _: driver.find_element(By.ID, "recorded").is_displayed())
    assert "tissue and the instruments" in text(driver, "#facts")
    alone = say("figure.without_detail", db="36.20 dB")
    of_both = say("figure.likeness_beside_copies", db="38.10 dB", best="30.00 dB")
    assert f"{of_both} {alone}" in text(driver, "#facts")
    assert driver.get_log("browser") == []

    inside = (folder / DETAIL).stat().st_size
    size = path.stat().st_size
    assert main(["export", str(folder), "--format", "html", "--recorded", "off"]) == ExitCode.OK
    assert path.stat().st_size < size - 4 * inside / 3
    opened(driver, path, "shown", "#compare=wipe")
    assert TABLE["recorded_off"] in text(driver, "#facts")
    assert f"{TABLE['fact_quality']}{alone}" in text(driver, "#facts")
    assert not driver.find_element(By.ID, "compare").is_displayed()
    monkeypatch.setattr("intrasplat.scene.player_page.MAX_RECORDED_BYTES", inside)
    large = b"".join(stored_parts("html", folder, ORIGIN, DASHBOARD))
    assert b'"state": "large"' in large
    assert len(large) < size - 4 * inside / 3
    asked = b"".join(stored_parts("html", folder, ORIGIN, DASHBOARD, recorded="on"))
    assert f'"{name_of("left", HELD_OUT, "jpg")}"'.encode() in asked
    assert f'"{name_of("right", HELD_OUT, "jpg")}"'.encode() not in asked  # nothing shows it


def test_its_policy_lets_nothing_out_and_nothing_in(driver: webdriver.Chrome, file: Path) -> None:
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', file.read_text(encoding="utf-8"))
    rules = dict(each.strip().partition(" ")[::2] for each in policy.split(";"))
    assert rules.pop("default-src") == "'none'"
    assert rules.keys() == {"script-src", "style-src", "worker-src", "base-uri", "form-action"}
    assert all(re.fullmatch(r"'sha256-[\w+/=]+'", rules[each]) for each in ("script-src", "style-src"))
    opened(driver, file, "shown")
    tried = driver.execute_async_script(
        "const done = arguments[0]; fetch('https://example.com/').then(() => done('out'), () => done('stopped'))"
    )
    assert tried == "stopped"


def test_without_webgl2_and_with_a_damaged_scene_it_says_so(driver: webdriver.Chrome, file: Path) -> None:
    spoilt = file.with_name("spoilt.html")
    content = file.read_text(encoding="utf-8")
    start = content.index('id="scene">') + 400
    spoilt.write_text(content[:start] + "AAAA" + content[start + 4 :], encoding="utf-8")
    opened(driver, spoilt, "refused")
    assert "damaged" in text(driver, "#message")
    with browser(("--disable-gpu", "--disable-3d-apis")) as blind:
        blind.execute_cdp_cmd("Emulation.setLocaleOverride", {"locale": "en-GB"})
        opened(blind, file, "refused")
        assert text(blind, "#message") == TABLE["refused"].format(why=TABLE["no_webgl2"])


def test_axe_finds_nothing_on_it(driver: webdriver.Chrome, file: Path, axe: str) -> None:
    driver.execute_cdp_cmd("Page.setBypassCSP", {"enabled": True})
    opened(driver, file, "shown")
    driver.find_element(By.CSS_SELECTOR, "summary").click()
    found = driver.execute_async_script(RUN, axe)
    assert found == []
    driver.execute_cdp_cmd("Page.setBypassCSP", {"enabled": False})


def test_the_command_line_writes_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored(tmp_path / "scene", small_scene())
    monkeypatch.setenv(DASHBOARD_VARIABLE, str(DASHBOARD))
    assert main(["export", str(tmp_path / "scene"), "--format", "html"]) == ExitCode.OK
    size, scene_size = (tmp_path / "scene.html").stat().st_size, (tmp_path / "scene/scene.safetensors").stat().st_size
    assert 4 * scene_size / 3 < size < 4 * scene_size / 3 + 400_000
    monkeypatch.setattr("intrasplat.scene.stored_exports.server_part", lambda name: None)
    monkeypatch.delenv(DASHBOARD_VARIABLE)
    assert main(["export", str(tmp_path / "scene"), "--format", "html"]) == ExitCode.UNAVAILABLE


def test_what_cannot_be_shown_so_is_refused_before_anything_is_sent(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="hexplane") as refused:
        stored_parts("html", stored(tmp_path / "planes", random_scene("hexplane")), None, DASHBOARD)
    assert refused.value.field == "format"
    with pytest.raises(SceneError):
        stored_parts("html", tmp_path, None, DASHBOARD)
    with pytest.raises(InputError, match="no recorded frames"):
        stored_parts("html", stored(tmp_path / "plain", small_scene()), None, DASHBOARD, recorded="on")
    with pytest.raises(UnavailableError, match="INTRASPLAT_DASHBOARD_DIR"):
        stored_parts("html", stored(tmp_path / "scene", small_scene()), None, tmp_path)


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ('import * as all from "./b.js";', "not understood"),
        ('import "./b.js";', "not understood"),
        ('const b = await import("./b.js");', "not understood"),
        ("export default 1;", "not understood"),
        ("export let a = 1;", "not understood"),
        ("const a = 1;\nexport { a };", "not understood"),
        ('import { a } from "./a.js";\nexport const a = 1;', "imports itself"),
        ("export const a = '</script>';", "would end the script"),
        ("console.log(import.meta.url);", "not understood"),
    ],
)
def test_a_form_that_the_inliner_does_not_know_is_refused(tmp_path: Path, source: str, problem: str) -> None:
    (tmp_path / "b.js").write_text("export const b = 1;\n")
    (tmp_path / "a.js").write_text(source)
    with pytest.raises(CannotInlineError, match=problem):
        inlined(tmp_path / "a.js")


def test_modules_keep_their_names_apart_and_are_made_once(driver: webdriver.Chrome, tmp_path: Path) -> None:
    (tmp_path / "b.js").write_text(
        "const own = 1;\nexport const made = [];\nmade.push(own);\nexport function f() { return own; }\n"
    )
    (tmp_path / "c.js").write_text(
        'import { made } from "./b.js";\nconst own = 2;\nmade.push(own);\nexport class C {}\n'
    )
    (tmp_path / "w.worker.js").write_text('import { f } from "./b.js";\npostMessage(f() + 40);\n')
    (tmp_path / "a.js").write_text(
        'import {\n  f as first,\n  made,\n} from "./b.js";\nimport { C } from "./c.js";\nconst own = 3;\n'
        'const worker = new Worker(new URL("./w.worker.js", import.meta.url), { type: "module" });\n'
        "worker.onmessage = ({ data }) => { document.title = [first(), ...made, own, typeof C, data].join(); };\n"
    )
    page = tmp_path / "a.html"
    page.write_text(f"<!doctype html><script>{inlined(tmp_path / 'a.js')}</script>")
    driver.get(page.as_uri())
    WebDriverWait(driver, OPENS_WITHIN_S).until(lambda _: driver.title == "1,1,2,3,function,41")


def test_a_page_has_one_module_its_workers_and_what_it_imports_later_shares_its_modules(
    driver: webdriver.Chrome, tmp_path: Path
) -> None:
    sources = {
        "parts/b.js": "/**\n * @returns {Promise<import('./c.js').C>}\n */\nexport const made = [];\nmade.push('b');\n",
        "parts/w.worker.js": 'import { made } from "./b.js";\npostMessage(made.length + 40);\n',
        "later/l.js": 'import { made } from "../parts/b.js";\nimport { own } from "./own.js";\n'
        'const href = new URL("x.css", import.meta.url).href;\n'
        'export const said = () => [...made, own, href.split("/").slice(-2)].join();\n',
        "later/own.js": "export const own = 'l';\n",
        "parts/start.js": 'import { made } from "./b.js";\nmade.push("start");\nexport const load = async () => {\n'
        '  const { said } = await import("../later/l.js");\n  return said();\n};\n'
        'export const work = () => new Worker(new URL("./w.worker.js", import.meta.url), { type: "module" });\n',
        "main.js": 'import { load, work } from "./parts/start.js";\nexport const main = "main";\n'
        "work().onmessage = async ({ data }) => (document.title = `${await load()},${data}`);\n",
        "index.html": '<!doctype html><script type="module" src="main.js"></script>',
    }
    for name, source in sources.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(source)
    scripts = joined(tmp_path / "main.js")
    names = {path.relative_to(tmp_path.resolve()).as_posix() for path in scripts}
    assert names == {"main.js", "parts/w.worker.js", "later/l.js"}
    for path, script in scripts.items():
        path.write_text(script)
    for name in ("parts/b.js", "parts/start.js", "later/own.js"):
        (tmp_path / name).unlink()
    files = partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), files) as server:
        threading.Thread(target=server.serve_forever).start()
        driver.get(f"http://127.0.0.1:{server.server_port}/")
        WebDriverWait(driver, OPENS_WITHIN_S).until(lambda _: driver.title == "b,start,l,later,x.css,41")
        server.shutdown()
