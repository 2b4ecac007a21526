"""One clip, the whole way: `intrasplat up`, upload over HTTP, training, renders, export, deletion, clean end."""

from __future__ import annotations

import io
import socket
from pathlib import Path

import cv2
import numpy as np
import pytest

from intrasplat_client import Client, JobRejected, JobState
from lab.demo import started_service
from lab.phantom import PhantomSettings, make_phantom, write_stereo_video

WIDTH, HEIGHT, FRAMES = 96, 80, 12
MIN_PSNR_DB = 20.0
"""Far below what thirty iterations reach, far above an empty, inverted or shifted picture."""


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phantom") / "clip"
    write_stereo_video(make_phantom(PhantomSettings(width=WIDTH, height=HEIGHT, frames=FRAMES)), folder)
    return folder


def pixels(content: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image, np.uint8)


def assert_renders(client: Client, scene: str) -> None:
    """Any time, pose, size and layer."""
    first = client.render(0.0, scene=scene)
    assert pixels(first.content).shape == (HEIGHT, WIDTH, 4)
    assert 0 <= first.unseen < 0.2
    assert (pixels(first.content)[..., 3] == 0).mean() == pytest.approx(first.unseen, abs=1e-3)
    assert pixels(client.render(0.0, scene=scene, unseen="guess").content).shape == (HEIGHT, WIDTH, 3)
    assert client.render(0.0, scene=scene).content == first.content
    assert client.render(0.5, pose="orbit:10,0,1").content != first.content
    assert pixels(client.render(0.5, scene=scene, width=WIDTH // 2).content).shape == (HEIGHT // 2, WIDTH // 2, 4)
    depth_mm = client.render(0.5, scene=scene, layer="depth", format="npy").array()
    assert depth_mm.shape == (HEIGHT, WIDTH)
    assert 10 < np.median(depth_mm[depth_mm > 0]) < 300
    confidence = client.render(0.5, scene=scene, layer="confidence", format="npy").array()
    assert confidence.min() >= 0
    assert 0 < confidence.max() <= 1
    beyond = client.render(2.0, scene=scene)
    assert beyond.t == pytest.approx((FRAMES - 1) / FRAMES, abs=1e-5)
    assert beyond.warning


def test_a_clip_sent_over_http_comes_back_as_renders_of_any_time_and_pose(tmp_path: Path, clip: Path) -> None:
    with started_service(tmp_path / "data", tmp_path / "service.log") as client:
        files = {"calibration": clip / "calibration.json", "masks": clip / "masks.zip"}
        job = client.reconstruct(clip / "stereo.webm", **files, iterations=30)
        assert client.wait(job.id).state is JobState.DONE
        report = client.report(job.id)
        assert report.psnr_tissue_db > MIN_PSNR_DB
        assert report.iterations == 30
        assert len(client.curve(job.id).splitlines()) >= 2
        assert_renders(client, job.id)
        ply = client.export(job.id, t=0.5)
        assert ply.startswith(b"ply\nformat binary_little_endian 1.0")
        assert f"element vertex {report.gaussians}".encode() in io.BytesIO(ply).read(2000)

        broken = client.reconstruct(clip / "stereo.webm", iterations=30)  # stereo without its calibration
        with pytest.raises(JobRejected) as rejected:
            client.wait(broken.id)
        assert rejected.value.field == "calibration"
        assert rejected.value.remedy

        client.delete(job.id)
        client.delete(broken.id)
        assert client.jobs() == []
        left = [path for path in (tmp_path / "data").rglob("*") if job.id in path.name or broken.id in path.name]
        assert left == []
    assert not [path for path in (tmp_path / "data" / "run").glob("*.sock") if _answers(path)]


def _answers(path: Path) -> bool:
    """Whether somebody still listens on a socket."""
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(str(path)) == 0
