"""The player in a browser that draws on the processor: it reads and shows what a worker does."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from selenium import webdriver

from intrasplat.scene.checkpoint import SCENE_FILE, load_scene, save_scene
from intrasplat.scene.compact import unpack
from intrasplat.scene.files import parse_tensors
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.deformation import SharedBasis
from tests.client.player import SCENES, TIE_LEVELS, Seen, drawing_browser, player_page
from tests.intrasplat.scene.compacting import compacted
from tests.intrasplat.scenes import random_scene

COUNT = 700
LEAST_DB = 50.0
RIGHT_EYE_MM = (4.0, 0.1, 0.0)


def scattered(channels: int, *, moves: bool) -> TrainedScene:
    """Gaussians of every shape, some needle-thin, some never seen, all over a small picture, as they are stored.

    moves: the camera.
    """
    scene = random_scene(count=COUNT, seed=channels)
    random = torch.Generator().manual_seed(channels)
    gaussians = dataclasses.replace(
        scene.gaussians,
        mean=scene.gaussians.mean * torch.tensor([12.0, 9.0, 1.0]),
        log_scale=1.2 * scene.gaussians.log_scale,
        opacity_logit=2 * scene.gaussians.opacity_logit,
        gloss=0.3 * torch.randn(COUNT, generator=random) if channels == 14 else torch.zeros(0),
    )
    assert isinstance(scene.deformation, SharedBasis)
    weight = 0.3 * torch.randn(COUNT, channels, 5, generator=random)
    seen = torch.where(gaussians.mean[:, 0] > 10, torch.tensor(0.0), scene.seen)
    still = np.tile(np.eye(4), (scene.frame_count, 1, 1))
    moved = dataclasses.replace(
        scene,
        gaussians=gaussians,
        deformation=SharedBasis(weight, scene.deformation.centre, scene.deformation.width),
        seen=seen,
        world_from_camera=scene.world_from_camera * 40 - 39 * still if moves else still,
        right_eye_mm=RIGHT_EYE_MM if channels == 14 else None,
    )
    return compacted(moved)


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    with drawing_browser() as driver:
        yield driver


@pytest.mark.parametrize(("channels", "moves"), [(10, True), (13, False), (14, True)])
def test_the_player_reads_and_draws_what_a_worker_does(
    driver: webdriver.Chrome, tmp_path: Path, channels: int, moves: bool
) -> None:
    save_scene(tmp_path, scattered(channels, moves=moves))
    scene = load_scene(tmp_path)
    table = unpack(parse_tensors((tmp_path / SCENE_FILE).read_bytes(), tmp_path)).table
    views = [
        Seen(0.0),
        Seen(0.31, is_marked=False),
        Seen(2 / 3, orbit=(12.0, -7.0, 1.6)),
        Seen(0.2, orbit=(-9.0, 4.0, 2.0, 6.0, -3.0, 50.0)),
        Seen(0.4, orbit=(0.0, 0.0, 2.12)),
        Seen(0.4, orbit=(0.0, 0.0, 6.0)),
        Seen(0.5, orbit=(-70.0, 20.0, 0.7), highlights=False),
        Seen(0.9, eye="right"),
    ]
    with player_page(driver, tmp_path) as page:
        assert page.read()["sha256"] == hashlib.sha256(np.ascontiguousarray(table, "<i4").tobytes()).hexdigest()
        page.load()
        for seen in views:
            for scale in (1.0, 2.5):
                compared = page.compare(scene, seen, scale)
                assert compared.rendered.std() > 10  # not an empty picture
                assert compared.psnr_db >= LEAST_DB, (seen, scale)
                assert compared.levels.max() <= TIE_LEVELS, (seen, scale)
                assert compared.codes[0] == compared.codes[1]
                assert compared.unseen[0] == pytest.approx(compared.unseen[1], abs=1e-3)
                assert compared.rendered.shape[1] == round(64 * scale)


@pytest.mark.parametrize("damage", ["hash", "length", "code"])
def test_a_damaged_scene_is_refused(driver: webdriver.Chrome, tmp_path: Path, damage: str) -> None:
    save_scene(tmp_path, scattered(10, moves=False))
    path, manifest = tmp_path / SCENE_FILE, tmp_path / "manifest.json"
    content = bytearray(path.read_bytes())
    before = hashlib.sha256(content).hexdigest()
    if damage == "length":
        content = content[:-1]
    else:
        content[-200] ^= 0xFF
    path.write_bytes(content)
    if damage == "code":
        manifest.write_text(manifest.read_text().replace(before, hashlib.sha256(content).hexdigest()))
    said = {"hash": "does not match its hash", "length": "bytes instead of", "code": r"A (code|number|power|share) of"}[
        damage
    ]
    with player_page(driver, tmp_path) as page, pytest.raises(AssertionError, match=said):
        page.load()


def test_a_scene_that_only_the_service_draws_is_said_to_be_one(driver: webdriver.Chrome, tmp_path: Path) -> None:
    save_scene(tmp_path, random_scene("hexplane"))
    with player_page(driver, tmp_path) as page, pytest.raises(AssertionError, match=r"hexplane.*drawn by the service"):
        page.load()


def test_a_screen_smaller_than_the_clip_is_drawn_in_the_clips_pixels(driver: webdriver.Chrome, tmp_path: Path) -> None:
    save_scene(tmp_path, scattered(10, moves=False))
    script = """
      const { Cameras } = await import("/player/camera.js");
      const manifest = await (await fetch(given[0] + "manifest.json")).json();
      const sizes = (wide) => {
        const cameras = new Cameras({ ...manifest, intrinsics: { ...manifest.intrinsics, ...wide } });
        return [0.3, 1, 2.5].map((scale) => Object.values(cameras.drawnSize(scale)));
      };
      return [sizes({}), sizes({ width: 3840, height: 2160 })];
    """
    with player_page(driver, tmp_path) as page:
        small, large = page.run(script, SCENES)
    assert small == [[64, 48], [64, 48], [160, 120]]
    assert large[0] == [1931, 1086]  # as many as are judged
    assert large[1:] == [[3840, 2160], [9600, 5400]]
