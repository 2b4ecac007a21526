"""The bridge against a real service and a pyigtl peer: what comes equals what the service renders and exports."""

from __future__ import annotations

import io
import socket
from collections.abc import Iterator

import numpy as np
import pyigtl
import pytest
import trimesh

from intrasplat_client import Client
from tests.client.page import Site
from tests.client.slicer.peers import DOUBT, Peer, bridge, free_port, peer_of, publish, rendering_site, until
from tests.intrasplat.export.sheet import tissue

SCENE = tissue()
FRAMES, CAMERA = SCENE.frame_count, SCENE.intrinsics
FRAME = 3
T = FRAME / FRAMES
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
ASIDE = np.array([[0.98480775, 0, -0.17364818, 8.0], [0, 1, 0, -2.0], [0.17364818, 0, 0.98480775, 5.0], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with rendering_site(tmp_path_factory.mktemp("data")) as site:
        yield site


@pytest.fixture(scope="module")
def scene(site: Site) -> str:
    return publish(site)


@pytest.fixture
def client(site: Site) -> Iterator[Client]:
    with Client(site.url) as client:
        yield client


@pytest.fixture
def standing(site: Site, scene: str) -> Iterator[Peer]:
    """A peer of a bridge that stands at FRAME and sends depth."""
    with bridge(scene, "--url", site.url, "--port", "0", "--t", str(T), "--depth") as running, peer_of(running) as peer:
        yield peer


def pose_text(pose: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return ",".join(repr(float(each)) for each in pose[:3].ravel())


def test_pictures_hold_the_renders_pixels_and_the_camera_is_the_endoscopes(
    standing: Peer, client: Client, scene: str
) -> None:
    picture, depth = standing.newest("IntrasplatPicture"), standing.newest("IntrasplatDepth")
    np.testing.assert_array_equal(picture.image[0], client.render_array(T, scene=scene))
    depth_mm = client.render_array(T, scene=scene, layer="depth")
    np.testing.assert_array_equal(depth.image[0], depth_mm)
    assert (picture.image.dtype, depth.image.dtype) == (np.uint8, np.float32)
    camera = standing.newest("IntrasplatCamera").matrix
    np.testing.assert_allclose(camera, FLIP @ SCENE.world_from_camera[FRAME] @ FLIP, atol=1e-6)
    status = standing.until_status("CURRENT", f"frame {FRAME} of 0 to {FRAMES - 1}", "endoscope's own pose")
    assert "Research use only" in status
    assert f"This scene: {DOUBT}" in status
    assert "% on average" in status


def test_a_view_tells_its_camera_over_http_and_over_the_stream(client: Client, scene: str) -> None:
    camera = client.render(T, scene=scene, width=32).camera
    with client.stream(scene) as viewer:
        assert viewer.render(T, width=32).camera == camera
    assert camera is not None
    assert (camera.width, camera.height, camera.fx, camera.cy) == (32, 24, CAMERA.fx / 2, CAMERA.cy / 2)
    assert camera.world_from_camera == tuple(SCENE.world_from_camera[FRAME, :3].ravel())


def test_a_point_of_the_tissue_lies_behind_its_pixel_as_seen_from_the_camera_in_ras(
    standing: Peer, client: Client, scene: str
) -> None:
    picture = standing.newest("IntrasplatPicture")
    assert picture.world_coordinate_system == "ras"
    eye = standing.newest("IntrasplatCamera").matrix[:3, 3]
    depth_mm = client.render_array(T, scene=scene, layer="depth")
    own = SCENE.world_from_camera[FRAME]
    for row, column in ((5, 9), (40, 50), (20, 31)):
        z = depth_mm[row, column]
        assert z > 0
        ray = [(column + 0.5 - CAMERA.cx) / CAMERA.fx * z, (row + 0.5 - CAMERA.cy) / CAMERA.fy * z, z, 1]
        tissue_ras = (FLIP @ own @ ray)[:3]
        pixel_ras = (picture.ijk_to_world_matrix @ [column, row, 0, 1])[:3]
        seen, shown = tissue_ras - eye, pixel_ras - eye
        beside_mm = np.linalg.norm(np.cross(seen, shown)) / np.linalg.norm(shown)
        assert beside_mm < 1e-3
    plane_mm = (np.linalg.inv(FLIP @ own) @ picture.ijk_to_world_matrix @ [0, 0, 0, 1])[2]
    assert plane_mm == pytest.approx(np.median(depth_mm[depth_mm > 0]), rel=0.02)


def test_the_surface_is_the_exported_mesh(standing: Peer, client: Client, scene: str) -> None:
    surface = standing.newest("IntrasplatSurface")
    content = client.export(scene, T, format="mesh-ply")
    mesh = trimesh.load(io.BytesIO(content), file_type="ply", force="mesh", process=False)
    np.testing.assert_array_equal(surface.points, mesh.vertices.astype(np.float32) * np.float32([-1, -1, 1]))
    np.testing.assert_array_equal(surface.polygons, mesh.faces)
    np.testing.assert_allclose(surface.attributes["RGB"], mesh.visual.vertex_colors[:, :3] / 255, atol=1e-6)
    standing.until_status(f"The surface is that of frame {FRAME}.")


def test_a_pose_from_slicer_shows_what_is_seen_from_there(standing: Peer, client: Client, scene: str) -> None:
    standing.picture()
    standing.send_pose(FLIP @ ASIDE @ FLIP)
    as_sent = ASIDE.astype(np.float32).astype(np.float64)
    there = client.render_array(T, scene=scene, pose=pose_text(as_sent))
    assert not np.array_equal(there, client.render_array(T, scene=scene))
    standing.until_picture(there)
    until(lambda: np.allclose(standing.newest("IntrasplatCamera").matrix, FLIP @ ASIDE @ FLIP, atol=1e-6))
    standing.until_status("CURRENT", "the pose that Slicer sends")
    standing.send("endoscope")
    standing.until_picture(client.render_array(T, scene=scene))


def test_a_pose_that_is_not_rigid_is_refused_and_the_picture_stays(standing: Peer, client: Client, scene: str) -> None:
    standing.picture()
    standing.send_pose(np.diag([2.0, 2.0, 2.0, 1.0]))
    standing.until_status("CURRENT", "The pose from IntrasplatPose is refused", "not rigid", "endoscope's own pose")
    standing.send_pose(np.full((4, 4), np.nan))
    standing.until_status("CURRENT", "is refused", "not finite")
    standing.send_pose(np.eye(4), device="SomebodyElse")
    standing.send("t=0")
    standing.until_status("frame 0 of", "endoscope's own pose")
    standing.until_picture(client.render_array(0.0, scene=scene))


def test_commands_play_pause_and_choose_a_moment(standing: Peer) -> None:
    standing.until_status(f"frame {FRAME}", "standing")
    standing.send("play")
    frames: set[str] = set()
    until(lambda: frames.add(standing.until_status("playing").partition("frame ")[2].split()[0]) or len(frames) > 2)
    standing.send("pause")
    standing.until_status("standing")
    standing.send("t = 0.5")
    standing.until_status(f"frame {FRAME}", "standing")
    for beyond, frame in ((1.5, FRAMES - 1), (-0.5, 0)):
        standing.send(f"t={beyond}")
        standing.until_status(f"t={beyond:g} is outside the clip", f"frame {frame} of", "standing")
    standing.send("t=1")
    assert "outside" not in standing.until_status(f"frame {FRAMES - 1} of")
    standing.send("faster")
    standing.until_status("'faster' is no command")


def test_a_bridge_plays_unless_told_otherwise_and_sends_pictures_of_the_width_asked_for(site: Site, scene: str) -> None:
    arguments = ("--url", site.url, "--port", "0", "--width", "32", "--surface", "never")
    with bridge(scene, *arguments) as running, peer_of(running) as peer:
        peer.until_status("CURRENT", "playing")
        picture = peer.newest("IntrasplatPicture")
        assert picture.image.shape == (1, 24, 32, 3)
        spacing_mm = np.linalg.norm(picture.ijk_to_world_matrix[:3, :2], axis=0)
        assert spacing_mm[0] * 32 * CAMERA.fx == pytest.approx(spacing_mm[1] * 24 * CAMERA.fy * 64 / 48, rel=1e-5)
        assert running.end() == 0
        peer.until_status("ENDED", "The bridge was ended.")


def test_a_peer_that_comes_back_has_everything_at_once_also_while_the_service_is_away(site: Site) -> None:
    scene = publish(site)
    with Client(site.url) as client:
        wanted = client.render_array(T, scene=scene)
    with bridge(scene, "--url", site.url, "--port", "0", "--t", str(T)) as running:
        with peer_of(running) as peer:
            peer.until_picture(wanted)
            peer.newest("IntrasplatSurface")
        until(lambda: "has gone" in running.said)
        site.stop()
        with peer_of(running) as peer:
            try:
                assert np.array_equal(peer.picture(), wanted)
                assert len(peer.newest("IntrasplatSurface").points) > 100
                peer.send("t=0")
                peer.until_status("STALE", "No service answers")
            finally:
                site.start()
            peer.until_status("CURRENT", "frame 0 of")


def test_a_deleted_scene_turns_black_and_ends_the_bridge(site: Site, client: Client) -> None:
    scene = publish(site)
    arguments = ("--url", site.url, "--port", "0", "--t", "0", "--depth", "--surface", "never")
    with bridge(scene, *arguments) as running, peer_of(running) as peer:
        assert peer.picture().any()
        peer.until_status("CURRENT")
        client.delete(scene)
        peer.until_status("ENDED", "scene")
        assert not peer.picture().any()
        assert running.ended() == 3
        assert "scene" in running.said


def test_strangers_are_shown_out_and_the_bridge_goes_on(site: Site, scene: str) -> None:
    arguments = ("--url", site.url, "--port", "0", "--t", "0", "--surface", "never")
    with bridge(scene, *arguments) as running:
        with socket.create_connection(("127.0.0.1", running.port)) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nAccept: */*\r\nUser-Agent: x\r\n\r\n")
            until(lambda: "what is not OpenIGTLink" in running.said)
        damaged = bytearray(pyigtl.TransformMessage(np.eye(4), device_name="IntrasplatPose").pack())
        damaged[-1] ^= 1
        with socket.create_connection(("127.0.0.1", running.port)) as stranger:
            stranger.sendall(damaged)
            until(lambda: "a damaged TRANSFORM" in running.said)
        with peer_of(running) as peer:
            peer.until_status("CURRENT")


def test_the_bridge_also_connects_to_a_slicer_that_listens(site: Site, scene: str, client: Client) -> None:
    port = free_port()
    arguments = ("--url", site.url, "--connect", "--port", str(port), "--t", str(T), "--surface", "never")
    with bridge(scene, *arguments) as running:
        until(lambda: "connecting to" in running.said)
        server = pyigtl.OpenIGTLinkServer(port, start_now=False)
        server.start()
        try:
            picture = server.wait_for_message("IntrasplatPicture", 60)
            np.testing.assert_array_equal(picture.image[0], client.render_array(T, scene=scene))
            assert running.end() == 0
        finally:
            server.stop()


@pytest.mark.parametrize(
    ("case", "code", "words"),
    [("no service", 5, "No service answers"), ("no scene", 3, "intrasplat jobs"), ("port taken", 5, "--port")],
)
def test_a_bridge_that_cannot_start_says_why(site: Site, scene: str, case: str, code: int, words: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1]) if case == "port taken" else "0"
        url = f"http://127.0.0.1:{free_port()}" if case == "no service" else site.url
        name = "0" * 32 if case == "no scene" else scene
        with bridge(name, "--url", url, "--port", port) as running:
            assert running.ended() == code
            assert words in running.said


def test_a_port_for_other_machines_comes_with_a_warning(site: Site, scene: str) -> None:
    with bridge(scene, "--url", site.url, "--port", "0", "--host", "0.0.0.0") as running:
        until(lambda: "neither keys nor encryption" in running.said)
        assert running.end() == 0


def test_a_moment_outside_the_clip_is_told_where_it_was_asked_for(site: Site, scene: str) -> None:
    with bridge(scene, "--url", site.url, "--port", "0", "--t", "1.5") as running:
        until(lambda: "t=1.5 is outside the clip" in running.said)
        assert running.end() == 0
