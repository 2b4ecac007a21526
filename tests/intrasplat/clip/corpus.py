"""A corpus of videos, folders and calibrations as recorders, editors and people write them; each is generated.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from intrasplat.intake.calibration.types import StereoCalibration, parse_calibration
from tests.intrasplat.clip.recorder import (
    Edit,
    Frames,
    copied,
    cut,
    damaged,
    long_header,
    record,
    record_bt709,
    woven,
)
from tests.intrasplat.clip.test_calibration import (
    HEIGHT,
    RECTIFIED,
    TRANSLATION_MM,
    WIDTH,
    ini_text,
    raw_calibration,
)
from tests.intrasplat.clip.test_calibration_forms import LISTS, SCARED

FRAMES, RATE_HZ, DISPARITY_PX, STEP_PX = 12, 25, 4, 3
QUIET = {"x265-params": "log-level=none"}
FASTSTART = {"movflags": "faststart"}

Eyes = tuple[Frames, Frames]
Pack = Callable[[Frames, Frames], Frames]
Outcome = Literal["accepted", "mended", "refused"]


@dataclass(frozen=True)
class Given:
    """The files of a clip, and what must be read from them."""

    clip: Path
    right: Path | None = None
    calibration: Path | None = None
    eyes: Eyes | None = None
    shown: Sequence[int] = range(FRAMES)  # the frames of eyes that the clip shows
    times_ms: Sequence[int] | None = None  # None: the clip has none
    cameras: StereoCalibration | None = None


Make = Callable[[Path], Given]


@dataclass(frozen=True)
class Variant:
    """One way to give a clip. said: the notice of what was mended, or words of the refusal of a field."""

    kind: Literal["video", "frames", "calibration"]
    given: str
    make: Make
    outcome: Outcome = "accepted"
    said: str = ""
    field: str = ""


@lru_cache
def film(frames: int = FRAMES, height: int = HEIGHT, width: int = WIDTH) -> Eyes:
    """(left, right) RGB [T, H, W, 3] of a coloured texture that moves to the left."""
    random = np.random.default_rng(3)
    columns = width + DISPARITY_PX + STEP_PX * frames
    grey, colour = random.uniform(70, 180, (height // 8, columns // 8)), random.uniform(-60, 60, (4, 6, 3))
    parts = [cv2.resize(each, (columns, height), interpolation=cv2.INTER_CUBIC) for each in (grey, colour)]
    texture = np.clip(parts[0][..., None] + parts[1], 0, 255).astype(np.uint8)
    starts = [STEP_PX * index for index in range(frames)]
    left = np.stack([texture[:, at : at + width] for at in starts])
    right = np.stack([texture[:, at + DISPARITY_PX : at + DISPARITY_PX + width] for at in starts])
    return left, right


def sbs(left: Frames, right: Frames) -> Frames:
    return np.concatenate([left, right], axis=2)


def tb(left: Frames, right: Frames) -> Frames:
    return np.concatenate([left, right], axis=1)


def split_by_a_line(left: Frames, right: Frames) -> Frames:
    return np.concatenate([left, np.zeros_like(left[:, :, :1]), right], axis=2)


# videos


def video(
    name: str = "clip.mp4", codec: str = "libx264", *, pack: Pack = sbs, edit: Edit | None = None,
    eyes: Callable[[], Eyes] = film, shown: Sequence[int] = range(FRAMES), even_ms: bool = True, **how: Any,
) -> Make:  # fmt: skip
    """A video of both eyes, edited. even_ms: the clip must show even times, whatever the file says."""

    def make(folder: Path) -> Given:
        left, right = eyes()
        path = record(folder / name, pack(left, right), codec=codec, **({"options": QUIET} | how))
        given_ms = [1000 // RATE_HZ * index for index in range(len(shown))] if even_ms else how["times_ms"]
        return Given(edit(path) if edit else path, eyes=(left, right), shown=shown, times_ms=given_ms)

    return make


def two_videos(right_frames: int = FRAMES, right_step_ms: int = 1000 // RATE_HZ, right_width: int = WIDTH) -> Make:
    def make(folder: Path) -> Given:
        left, right = film()
        times_ms = [right_step_ms * index for index in range(right_frames)]
        cut = right[:right_frames, :, :right_width]
        paths = record(folder / "a.mp4", left), record(folder / "b.mkv", cut, times_ms=times_ms)
        return Given(*paths, eyes=(left, right), times_ms=times_ms)

    return make


def fields_of_film() -> Eyes:
    """Moments of the first fields."""
    left, right = film(2 * FRAMES)
    return left[0::2], right[0::2]


def weave(order: str) -> Pack:
    return lambda left, right: woven(sbs(*film(2 * FRAMES)), order)


def squeezed() -> Eyes:
    left, right = (np.stack([cv2.resize(each, (WIDTH // 2, HEIGHT)) for each in eye]) for eye in film())
    return left, right


VARYING_MS = [0, 40, 120, 160, 240, 280, 360, 400, 520, 560, 600, 680]
JUMP_MS = [40 * index + (3_600_000 if index >= 6 else 0) for index in range(FRAMES)]
PAIRED_MS = [40 * (index // 2) for index in range(FRAMES)]
INTRA = {"keyframes": 4, "options": {"bf": "0"}}
LOSSLESS = {"pixel_format": "yuv444p", "options": {"crf": "0"}}
UNLIKE = "does not look like two eyes in one picture"
NO_VIDEO = "is not an mp4, mov, mkv or webm file"
NO_TEXT, NO_SCALE = "is not a text file", "not one uniform scale"
CODEC, CUT = "is encoded as … which is not accepted", "ends after the file does"
# Not here, because no outcome is decided: PQ and HLG (HDR) are read as if they were BT.709, without a notice.
VIDEOS: list[tuple[str, Make]] = [
    ("H.264 in mp4, side by side", video()),
    ("H.264 in mov, top-bottom", video("clip.mov", pack=tb)),
    ("H.264 in mkv", video("clip.mkv")),
    ("HEVC in mp4", video(codec="libx265")),
    ("VP9 in webm", video("clip.webm", "libvpx-vp9", options={"b": "0", "cpu-used": "8"})),
    ("VP9 in mp4", video("clip.mp4", "libvpx-vp9", options={"b": "0", "cpu-used": "8"})),
    ("Motion JPEG in mov", video("clip.mov", "mjpeg", pixel_format="yuvj420p", options={"qmin": "1", "qmax": "3"})),
    ("Motion JPEG in mkv", video("clip.mkv", "mjpeg", pixel_format="yuvj420p", options={"qmin": "1", "qmax": "3"})),
    ("fragmented mp4", video(options={"movflags": "frag_keyframe+empty_moov"})),
    ("RGB without loss", video(codec="libx264rgb", pixel_format="rgb24", options={"crf": "0"})),
    ("4:2:2", video(pixel_format="yuv422p")),
    ("4:4:4 without loss", video(**LOSSLESS)),
    ("10 bit HEVC", video("clip.mkv", "libx265", pixel_format="yuv420p10le")),
    ("full range", video(pixel_format="yuvj420p")),
    ("BT.709 in full range", video(edit=lambda path: record_bt709(path, sbs(*film())))),
    ("eyes of 155x121 pixels", video(eyes=lambda: film(FRAMES, 121, 155), **LOSSLESS)),
    ("one file an eye, in mp4 and mkv", two_videos()),
    ("a start at 300 ms", video(times_ms=[300 + 40 * index for index in range(FRAMES)])),
    ("a clock from 36,000 s", video("clip.mkv", times_ms=[36_000_000 + 40 * index for index in range(FRAMES)])),
    ("frames of varying length", video("clip.mkv", times_ms=VARYING_MS, even_ms=False)),
    ("sound from 500 ms before the pictures, and longer", video(edit=copied(sound_s=3.0, early_ms=-500))),
    ("a header that names the sound's length", video("clip.mkv", edit=long_header)),
    ("a copy from between keyframes", video("clip.mkv", edit=copied(first=2), shown=range(4, FRAMES), **INTRA)),
    ("an edit list that hides 4 frames", video(
        edit=copied(early_ms=160, options={"avoid_negative_ts": "disabled"}), shown=range(4, FRAMES), **INTRA)),
]  # fmt: skip
MENDED_VIDEOS: list[tuple[str, Make, str]] = [
    ("fields, upper first", video(pack=weave("tff"), eyes=fields_of_film), "interlaced"),
    ("fields, lower first, coded as such", video(
        pack=weave("bff"), eyes=fields_of_film,
        options={"flags": "+ilme+ildct", "x264-params": "bff=1"}), "interlaced"),
    ("eyes squeezed to half their width", video(eyes=squeezed, pixel_aspect=Fraction(2)), "pixel_aspect"),
    ("eyes squeezed to half their height", video(pack=tb, pixel_aspect=Fraction(1, 2)), "pixel_aspect"),
    ("a turn of 180 degrees for players", video(rotation_deg=180), "rotation"),
    ("a turn of 90 degrees for players", video("clip.mov", rotation_deg=90), "rotation"),
    ("time stamps that jump by an hour", video("clip.mkv", times_ms=JUMP_MS), "frame_times"),
    ("time stamps in equal pairs", video("clip.mkv", times_ms=PAIRED_MS), "frame_times"),
    ("damage in the middle", video(
        edit=lambda path: damaged(path, 6), shown=[*range(6), 5, 5, *range(8, FRAMES)], **INTRA), "damaged_frames"),
    ("an odd column between the eyes", video(pack=split_by_a_line, **LOSSLESS), "middle_line_unused"),
]  # fmt: skip
REFUSED_VIDEOS: list[tuple[str, Make, str]] = [
    ("FFV1", video("clip.mkv", "ffv1"), CODEC),
    ("VP8", video("clip.webm", "libvpx", options={"b": "900k"}), CODEC),
    ("ProRes", video("clip.mov", "prores_ks", pixel_format="yuv422p10le"), CODEC),
    ("avi", video("clip.avi"), NO_VIDEO),
    ("an MPEG transport stream", video("clip.ts"), NO_VIDEO),
    ("mp4 without its last fifth", video(edit=cut(0.8), options=FASTSTART), CUT),
    ("mkv without its last fifth", video("clip.mkv", edit=cut(0.8)), CUT),
    ("mp4 without its index, as after a crash", video(edit=cut(0.5)), CUT),
    (
        "damage in most frames",
        video(edit=lambda path: damaged(path, 2), options={"bf": "0"}),
        "10 of the 12 frames … are damaged",
    ),
    ("one eye alone", video(pack=lambda left, right: left), UNLIKE),
]
REFUSED_PAIRS: list[tuple[str, Make, str]] = [
    ("eyes of 12 and 10 frames", two_videos(10), "the right eye has 10 frames, the left 12"),
    (
        "eyes of 25 and 50 frames a second",
        two_videos(right_step_ms=20),
        "the right eye has 50 frames a second, the left 25",
    ),
    ("eyes of 160 and 128 columns", two_videos(right_width=128), "the right eye is 128x128 pixels, the left 160x128"),
]


# frames in folders and zips


def folder(
    left: str, right: str, *, extra: dict[str, bytes] | None = None, cameras: StereoCalibration | None = None
) -> Make:
    """Pictures named by patterns with {} for the number, and other files."""

    def make(root: Path) -> Given:
        eyes = film()
        for pattern, eye in zip((left, right), eyes, strict=True):
            for index, pixels in enumerate(eye):
                path = root / "clip" / pattern.format(f"{index:06d}")
                path.parent.mkdir(parents=True, exist_ok=True)
                assert cv2.imwrite(str(path), pixels[:, :, ::-1])
        for name, data in (extra or {}).items():
            (root / "clip" / name).parent.mkdir(parents=True, exist_ok=True)
            (root / "clip" / name).write_bytes(data)
        return Given(root / "clip", eyes=eyes, cameras=cameras)

    return make


def zipped(make: Make, rename: Callable[[str], str] = str) -> Make:
    def zip_it(root: Path) -> Given:
        given = make(root)
        path = root / "clip.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for file in sorted(given.clip.rglob("*.*")):
                entry = zipfile.ZipInfo("placeholder")
                entry.filename = entry.orig_filename = rename(file.relative_to(given.clip).as_posix())
                archive.writestr(entry, file.read_bytes())
        return replace(given, clip=path)

    return zip_it


def picture(index: int) -> bytes:
    encoded: bytes = cv2.imencode(".png", film()[0][index])[1].tobytes()
    return encoded


PNG_PAIR = "left/{}.png", "right/{}.png"
LITTER = {"__MACOSX/left/._000000.png": b"\0\5\x16\7", "left/.DS_Store": b"\0", "Thumbs.db": b"\0", "notes.txt": b"no"}
FOLDERS: list[tuple[str, Make]] = [
    ("a folder with left/ and right/", folder(*PNG_PAIR)),
    ("left_frames/ and right_frames/", folder("left_frames/{}.png", "right_frames/{}.png")),
    ("L/ and R/", folder("L/{}.png", "R/{}.png")),
    ("image01/ and image02/ of JPEG", folder("image01/{}.jpg", "image02/{}.jpg")),
    ("names like 000001l.png beside StereoCalibration.ini", folder(
        "{}l.png", "{}r.png", extra={"StereoCalibration.ini": ini_text().encode()}, cameras=raw_calibration())),
    ("names in capitals", folder("LEFT/{}.PNG", "RIGHT/{}.PNG")),
    ("a zip", zipped(folder(*PNG_PAIR))),
    ("a zip with backslashes of Windows", zipped(folder(*PNG_PAIR), lambda name: name.replace("/", "\\"))),
    ("a zip with a wrapping folder", zipped(folder(*PNG_PAIR), lambda name: f"Größe 3/{name}")),
    ("a zip with __MACOSX/ and Thumbs.db", zipped(folder(*PNG_PAIR, extra=LITTER))),
]  # fmt: skip
REFUSED_FOLDERS: list[tuple[str, Make, str]] = [
    ("a picture of neither eye", folder(*PNG_PAIR, extra={"other/0.png": picture(0)}),
     "names neither the left nor the right eye"),
    ("three cameras", folder("cam0/{}.png", "cam1/{}.png", extra={"cam2/000000.png": picture(0)}), UNLIKE),
    ("a frame of one eye", folder(*PNG_PAIR, extra={"left/000012.png": picture(0)}), "has no frame of the right eye"),
    ("TIFF", folder("left/{}.tif", "right/{}.tif"), "holds neither a video nor frames (PNG or JPEG)"),
    ("a picture without its end", folder(*PNG_PAIR, extra={
        "left/000003.png": picture(3)[:-400]}), "is damaged or cut short"),
    ("a zip in a zip", zipped(folder(*PNG_PAIR, extra={"more.zip": b"PK"})), "is an archive inside the archive"),
]  # fmt: skip


# calibrations


def opencv_text(name: str = "c.yaml", edit: Callable[[str], str] = str, **changes: Any) -> str:
    """A calibration in the format of the name that OpenCV chooses, edited."""
    storage = cv2.FileStorage(name, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    values = {"image_width": WIDTH, "image_height": HEIGHT, **{name: np.array(LISTS[name]) for name in NAMES}} | changes
    for name, value in values.items():
        if value is not None:
            storage.write(name, value)
    written: str = storage.releaseAndGetString()
    return edit(written)


NAMES = "M1", "D1", "M2", "D2", "R", "T"


def calibrated(name: str, data: str | bytes, cameras: StereoCalibration | None = None) -> Make:
    def make(root: Path) -> Given:
        path = root / name
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
        return replace(video()(root), calibration=path, cameras=cameras or raw_calibration())

    return make


def npz() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **{name: np.array(LISTS[name]) for name in NAMES})
    return buffer.getvalue()


WHOLE = parse_calibration(RECTIFIED)
LATIN = opencv_text() + "# für Gerät 2\n"
CALIBRATIONS: list[tuple[str, Make]] = [
    ("our JSON", calibrated("c.json", json.dumps(RECTIFIED), WHOLE)),
    ("OpenCV's YAML", calibrated("c.yaml", opencv_text())),
    ("OpenCV's XML", calibrated("c.xml", opencv_text("c.xml"))),
    (
        "comments",
        calibrated("c.yaml", opencv_text(edit=lambda text: "# above\n" + text.replace("rows: 3", "rows: 3  # 3"))),
    ),
    ("tabs", calibrated("c.yml", opencv_text(edit=lambda text: text.replace("   ", "\t")))),
    ("CRLF", calibrated("c.yml", opencv_text(edit=lambda text: text.replace("\n", "\r\n")))),
    ("UTF-8 with its mark", calibrated("c.yml", LATIN.encode("utf-8-sig"))),
    ("UTF-16", calibrated("c.yml", LATIN.encode("utf-16"))),
    ("Latin-1", calibrated("c.yml", LATIN.encode("latin-1"))),
    ("lists in JSON", calibrated("c.json", json.dumps(LISTS))),
    ("StereoMIS's ini", calibrated("StereoCalibration.ini", ini_text())),
]
MENDED_CALIBRATIONS: list[tuple[str, Make, str]] = [
    ("SCARED's JSON without image size", calibrated("frame_data.json", json.dumps(SCARED)), "calibration"),
    ("YAML without image size", calibrated("c.yaml", opencv_text(image_width=None, image_height=None)), "calibration"),
    ("twice the size of the frames", calibrated("c.json", WHOLE.resized(2 * WIDTH, 2 * HEIGHT).model_dump_json(
        exclude={"scaled_from", "assumptions"}), WHOLE), "calibration_scaled"),
]  # fmt: skip
REFUSED_CALIBRATIONS: list[tuple[str, Make, str]] = [
    ("T in centimetres", calibrated("c.yaml", opencv_text(T=TRANSLATION_MM / 10)),
     "it is probably in centimetres, which would be 4.201 mm"),
    ("T in metres", calibrated("c.yaml", opencv_text(T=TRANSLATION_MM / 1000)),
     "it is probably in metres, which would be 4.201 mm"),
    ("a baseline of 120 mm", calibrated("c.json", json.dumps(RECTIFIED | {"baseline_mm": 120})),
     "no unit makes it that of a stereo endoscope"),
    ("a fisheye model", calibrated("c.yaml", opencv_text() + "distortion_model: fisheye\n"),
     "it is of a fisheye model"),
    ("NaN in YAML", calibrated("c.yaml", opencv_text(edit=lambda text: text.replace("130.", ".NaN", 1))),
     "fx_px: Input should be a finite number"),
    ("NaN in JSON", calibrated("c.json", json.dumps(RECTIFIED | {"fx_px": float("nan")})),
     "fx_px: Input should be a finite number"),
    ("decimal commas in YAML", calibrated("c.yaml", opencv_text(edit=lambda text: text.replace("130.5", "130,5"))),
     "M1 in line 5 announces 3 x 3 numbers and has 10"),
    ("decimal commas in an ini", calibrated("c.ini", ini_text(fc_x="131,0")), "the ini lacks a number … '131,0'"),
    ("npz", calibrated("c.npz", npz()), NO_TEXT),
    ("UTF-16 without its mark", calibrated("c.yml", LATIN.encode("utf-16-le")), NO_TEXT),
    ("one camera", calibrated("c.yaml", opencv_text(M2=None, D2=None, R=None, T=None)), "found no M2, R, T"),
    ("eyes that are swapped", calibrated("c.yaml", opencv_text(T=-TRANSLATION_MM)),
     "puts the right eye to the left of the left one"),
    ("one of another aspect", calibrated("c.json", json.dumps(RECTIFIED | {"width": 200})), NO_SCALE),
    ("the size of both eyes", calibrated("c.json", json.dumps(RECTIFIED | {"width": 2 * WIDTH})), NO_SCALE),
]  # fmt: skip


CORPUS = [
    *(Variant("video", *each) for each in VIDEOS),
    *(Variant("video", given, make, "mended", said) for given, make, said in MENDED_VIDEOS),
    *(Variant("video", given, make, "refused", said, "clip") for given, make, said in REFUSED_VIDEOS),
    *(Variant("video", given, make, "refused", said, "right") for given, make, said in REFUSED_PAIRS),
    *(Variant("frames", *each) for each in FOLDERS),
    *(Variant("frames", given, make, "refused", said, "clip") for given, make, said in REFUSED_FOLDERS),
    *(Variant("calibration", *each) for each in CALIBRATIONS),
    *(Variant("calibration", given, make, "mended", said) for given, make, said in MENDED_CALIBRATIONS),
    *(
        Variant("calibration", given, make, "refused", said, "calibration")
        for given, make, said in REFUSED_CALIBRATIONS
    ),
]
