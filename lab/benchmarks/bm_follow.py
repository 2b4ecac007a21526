"""How well, how soon and how steadily a follower follows a feed: a clip is played to and fro, each pair at its time.

    python -m lab.benchmarks.bm_follow [--clips d4d_stereo phantom:breathing:72frames:stereo ...] [--width 320]
        [--seconds 10] [--fps 30] [--pace real | --pace 6 --steps 12] [--views-hz 5] [--cover-s 0] [--no-offline]

--pace real: by the clock; the newest pair is taken whenever the follower is free, beside a thread that asks for a view
views-hz times a second. --pace K: every K-th pair is used and gets --steps steps, whatever the machine can do.

--cover-s: seconds from the middle of the run for which the lens is covered: its pairs are black. Printed is how long
after it the first pair was followed in the same world.

Scores are psnr_tissue in dB, of the left and the right eye, and causal: `now` is a pair before it trains, as the model
shows the newest moment; `copy` beside it the last used pair as it is, whose left picture is warped for the right eye;
`later` is a used pair a second after it came, `between` a pair that was not used, then, without and with detail.
`offline` is preset instant on all pairs (rectified, matched and masked by the same eyes), at the used ones. flicker:
standard deviation over time, in grey levels, of the used frames as they are shown a second later, over the fifth of the
tissue that changes least in the recording; beside it the recording's own, and that of `offline`.
"""

from __future__ import annotations

import argparse
import os
import resource
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.clip.types import Eye, RgbFrame
from intrasplat.decode import decode_clip
from intrasplat.decode.decoding import StereoRecording
from intrasplat.intake.calibration.types import RawCalibration, RectifiedCalibration
from intrasplat.live.eyes import EyesSettings
from intrasplat.live.follow import Added, Follower, FollowSettings
from intrasplat.live.pair import FeedPair
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.quality.right_eye import warped_left
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.splat.cpu import compile_kernels
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from intrasplat.train.scoring import judged_pixels
from intrasplat.view.camera import endoscope_pose
from intrasplat.view.render import render_frame
from lab.evaluate.sources import DATA_VARIABLE, Source, source_of
from lab.phantom import make_phantom

CLIPS = ("d4d_stereo", "phantom:breathing:72frames:stereo", "phantom:pull:72frames:stereo")
LATER_S, RESTING_SHARE = 1.0, 0.2
Score = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Played:
    """A clip played to and fro: pairs as recorded, the calibration, and the true path of a phantom's camera, mm."""

    pairs: Sequence[tuple[RgbFrame, RgbFrame]]
    calibration: RectifiedCalibration | RawCalibration
    fps: float
    path_mm: NDArray[np.float64] | None = None
    covered: range = range(0)
    """Pairs of the feed that are black."""

    def place(self, number: int) -> int:
        """The clip's frame that a pair of the feed shows."""
        last = len(self.pairs) - 1
        place = number % (2 * last)
        return min(place, 2 * last - place)

    def pair(self, number: int, arrived_at: float) -> FeedPair:
        left, right = self.pairs[self.place(number)]
        if number in self.covered:
            left, right = np.zeros_like(left), np.zeros_like(right)
        return FeedPair(left, right, number / self.fps, arrived_at, number)


@dataclass(eq=False)
class Found:
    """What was measured: scores by name, shown pictures of the used frames a second later, ages in s."""

    scores: dict[str, list[Score]] = field(default_factory=dict)
    shown: list[NDArray[np.uint8]] = field(default_factory=list)
    used: list[int] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    first_s: float = 0.0
    seconds: float = 0.0
    steps: int = 0
    path_mm: list[float] = field(default_factory=list)
    lost: int = 0
    cpu_s: float = 0.0

    def add(self, name: str, score: Score) -> None:
        self.scores.setdefault(name, []).append(score)


def main(arguments: Sequence[str] | None = None) -> None:
    options = _parser().parse_args(arguments)
    os.environ.setdefault(DATA_VARIABLE, "../shared/data")
    compile_kernels(lambda _: None)
    for name in options.clips:
        played = played_of(source_of(name), options.fps)
        eyes = EyesSettings(width=options.width, finds_instruments=not options.no_instruments)
        changed: dict[str, Any] = {name: float(text) if "." in text else int(text) for name, text in options.set}
        settings = FollowSettings(eyes, keep_s=options.seconds, camera=options.camera, **changed)
        if options.pace != "real":
            settings = replace(settings, steps=options.steps)
        reader = Follower(played.calibration, settings)
        truth = [reader.read(played.pair(number, 0.0)) for number in range(len(played.pairs))]
        middle = round(options.seconds * options.fps / 2)
        played = replace(played, covered=range(middle, middle + round(options.cover_s * options.fps)))
        if options.pace == "real":
            found, follower = in_real_time(played, settings, options.seconds, options.views_hz, options.budget_s)
            score_past(follower, truth, played, found)
        else:
            found, follower = by_steps(played, settings, options.seconds, int(options.pace), truth)
        offline = None if options.no_offline else offline_scores(truth, played, found, options.iterations)
        _print(name, played, found, _recorded(truth, played, found), offline)


def played_of(source: Source, fps: float) -> Played:
    """The pairs of a source, as recorded, in memory."""
    if source.phantom is not None:
        phantom = make_phantom(source.phantom)
        drawn = phantom.stereo_recording(masks=False)
        path_mm = np.stack([phantom.world_from_camera(i)[:3, 3] for i in range(drawn.clip.frame_count)])
        return Played(list(drawn.clip.pairs()), drawn.calibration, fps, path_mm)
    decoded = decode_clip(source.clip, calibration=source.files.get("calibration"))
    assert isinstance(decoded, StereoRecording)
    return Played(list(decoded.clip.pairs()), decoded.calibration, fps)


def by_steps(
    played: Played, settings: FollowSettings, seconds: float, every: int, truth: Sequence[DepthClip | None]
) -> tuple[Found, Follower]:
    """Use every `every`-th pair; score each before it trains, and all of them a second later."""
    follower, found, waiting = Follower(played.calibration, settings), Found(), list[int]()
    began_s = time.perf_counter()
    for number in range(round(seconds * played.fps)):
        waiting.append(number)
        if number % every == 0:
            _score_now(follower, truth, played, found, number)
            start_s, cpu_s = time.perf_counter(), time.process_time()
            became = follower.add(played.pair(number, 0.0))
            found.ages_s.append(time.perf_counter() - start_s)
            found.cpu_s += time.process_time() - cpu_s
            found.first_s = found.first_s or time.perf_counter() - start_s
            _took(follower, became, played, found, number)
        while waiting and number - waiting[0] >= LATER_S * played.fps and number % every == 0:
            _score_later(follower, truth, played, found, waiting.pop(0))
    found.steps, found.seconds = follower.iteration, time.perf_counter() - began_s
    return found, follower


def in_real_time(
    played: Played, settings: FollowSettings, seconds: float, views_hz: float, budget_s: float
) -> tuple[Found, Follower]:
    """Use the newest pair whenever the follower is free; ages of views that another thread asks for."""
    follower, found, ended = Follower(played.calibration, settings), Found(), threading.Event()
    began = time.time()

    def look() -> None:
        while not ended.wait(1 / views_hz):
            shown = follower.scene_at()
            if shown is None:
                continue
            scene, t = shown
            render_frame(scene, t, detail="off")
            arrived_at = began + scene.frame_times_s[-1]
            found.ages_s.append(time.time() - arrived_at)
            found.first_s = found.first_s or time.time() - began

    viewer = threading.Thread(target=look)
    viewer.start()
    last, cpu_s, ahead = -1, time.process_time(), list[FeedPair]()

    def newest() -> list[FeedPair]:
        number = int((time.time() - began) * played.fps)
        return [] if number == last else [played.pair(number, began + number / played.fps)]

    def coming() -> FeedPair | None:
        ahead[:] = newest()
        return next(iter(ahead), None)

    while time.time() - began < seconds:
        pair = next(iter(ahead or newest()), None)
        ahead.clear()
        if pair is None:
            time.sleep(1 / played.fps / 4)
            continue
        last = pair.sequence
        _took(follower, follower.add(pair, budget_s, coming), played, found, last)
    found.cpu_s = time.process_time() - cpu_s
    ended.set()
    viewer.join()
    found.steps, found.seconds = follower.iteration, seconds
    return found, follower


def _took(follower: Follower, became: Added, played: Played, found: Found, number: int) -> None:
    """Note what became of a pair, and how far its pose is from the true one."""
    if became not in (Added.FIRST, Added.FOLLOWED):
        found.lost += 1
        return
    found.used.append(number)
    assert follower.newest is not None
    if played.path_mm is not None:
        off_mm = follower.newest.clip.world_from_camera[0, :3, 3] - played.path_mm[played.place(number)]
        found.path_mm.append(float(np.linalg.norm(off_mm)))


def score_past(follower: Follower, truth: Sequence[DepthClip | None], played: Played, found: Found) -> None:
    """Score the used frames, and some between, as they are shown in the end."""
    used = set(found.used)
    for number in range(found.used[0], found.used[-1]):
        if number in used or number % 4 == 0:
            _score_later(follower, truth, played, found, number)


def offline_scores(
    truth: Sequence[DepthClip | None], played: Played, found: Found, iterations: int | None
) -> tuple[Score, float]:
    """Mean scores of the used frames by a model of the whole clip, and its flicker."""
    clips = [clip for clip in truth if clip is not None]
    assert len(clips) == len(truth), "every pair of a clip for this benchmark shows a scene"
    clip = _joined(clips)
    asked = ReconstructionOptions(preset="instant", holdout="none", iterations=iterations, poses="fixed")
    with TemporaryDirectory() as folder:
        reconstruct(ReconstructionRequest(clip=clip, options=asked), Path(folder), TrainingHooks())
        scene = load_scene(Path(folder))
    shown, scores = [], list[Score]()
    for number in found.used[: len(found.shown)]:
        place = played.place(number)
        pictures = _shown(scene, place / len(truth), clips[place])
        shown.append(pictures[0])
        scores.append(_score(pictures, clips[place]))
    return _mean(scores), flicker(shown, _recorded(truth, played, found))


def _recorded(truth: Sequence[DepthClip | None], played: Played, found: Found) -> list[DepthClip]:
    """The used frames that were shown a second later, as recorded."""
    clips = [truth[played.place(number)] for number in found.used[: len(found.shown)]]
    return [clip for clip in clips if clip is not None]


def _joined(clips: Sequence[DepthClip]) -> DepthClip:
    """The clip of these moments."""
    first, rights = clips[0], [clip.right for clip in clips if clip.right is not None]
    left = _stacked(clips)
    return replace(
        first, frame_times_s=np.arange(len(clips)) / 25, right=replace(rights[0], **_stacked(rights)), **left
    )


def _stacked(eyes: Sequence[Eye]) -> dict[str, Any]:
    """The arrays of several moments as those of one eye."""
    parts = [eye.arrays_at(slice(0, 1)) for eye in eyes]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _score_now(
    follower: Follower, truth: Sequence[DepthClip | None], played: Played, found: Found, number: int
) -> None:
    shown, clip, newest = follower.scene_at(), truth[played.place(number)], follower.newest
    if shown is None or clip is None or newest is None:
        return
    found.add("now", _score(_shown(*shown, clip), clip))
    last = newest.clip
    found.add("copy", _score((last.rgb[0], warped_left(last, 0)), clip))


def _score_later(
    follower: Follower, truth: Sequence[DepthClip | None], played: Played, found: Found, number: int
) -> None:
    shown, clip = follower.scene_at(number / played.fps), truth[played.place(number)]
    if shown is None or clip is None:
        return
    pictures = _shown(*shown, clip)
    is_used = number in found.used
    found.add("later" if is_used else "between", _score(pictures, clip))
    if is_used:
        found.shown.append(pictures[0])
    else:
        found.add("between, detail", _score(_shown(*shown, clip, detail=True), clip))


def _shown(
    scene: TrainedScene, t: float, clip: DepthClip, *, detail: bool = False
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The scene's pictures from both eyes, without detail of the recorded frames or with it."""
    assert clip.right is not None
    left = endoscope_pose(scene, t)
    right = left @ np.linalg.inv(clip.world_from_camera[0]) @ clip.right.world_from_camera[0]
    views = ((left, None), (right, clip.right.intrinsics))
    one, other = (render_frame(scene, t, pose, lens, detail="on" if detail else "off").rgb for pose, lens in views)
    return one, other


def _score(pictures: tuple[NDArray[np.uint8], NDArray[np.uint8]], clip: DepthClip) -> Score:
    assert clip.right is not None
    left = psnr_tissue(pictures[0], clip.rgb[0], clip.tissue[0])
    return left, psnr_tissue(pictures[1], clip.right.rgb[0], judged_pixels(clip.right, 0))


def flicker(pictures: Sequence[NDArray[np.uint8]], clips: Sequence[DepthClip]) -> float:
    """As the module describes it; NaN for too few frames."""
    recorded, shown = (np.stack(each).astype(np.float32) for each in ([clip.rgb[0] for clip in clips], pictures))
    tissue = np.logical_and.reduce([clip.tissue[0] for clip in clips])
    if len(shown) < 3 or not tissue.any():
        return float("nan")
    changes = recorded.std(0).mean(-1)
    rests = tissue & (changes <= np.quantile(changes[tissue], RESTING_SHARE))
    return float(shown.std(0).mean(-1)[rests].mean())


def _mean(scores: Sequence[Score]) -> Score:
    left, right = np.nanmean(np.array(scores), axis=0).tolist()
    return left, right


def _print(
    name: str, played: Played, found: Found, recorded: Sequence[DepthClip], offline: tuple[Score, float] | None
) -> None:
    def texts() -> Iterator[str]:
        yield name
        yield f"used {len(found.used) / found.seconds:.2f}/s, {found.steps / len(found.used):.1f} steps each"
        yield f"{1e3 * found.cpu_s / len(found.used):.0f} ms of a core each"
        p50, p95 = np.percentile(found.ages_s[1:], (50, 95))
        yield f"age p50 {p50:.2f} p95 {p95:.2f} s, first {found.first_s:.2f} s"
        for kind, scores in found.scores.items():
            yield f"{kind} {_mean(scores)[0]:.2f} {_mean(scores)[1]:.2f}"
        if offline is not None:
            yield f"offline {offline[0][0]:.2f} {offline[0][1]:.2f}, its flicker {offline[1]:.2f}"
        yield f"flicker {flicker(found.shown, recorded):.2f}"
        yield f"of the recording {flicker([clip.rgb[0] for clip in recorded], recorded):.2f}"
        if any(found.path_mm):
            yield f"path off by {np.mean(found.path_mm):.2f} mm, at most {max(found.path_mm):.2f}"
        if played.covered:
            again = [number for number in found.used if number >= played.covered.stop]
            yield f"followed {(again[0] - played.covered.stop) / played.fps:.2f} s after the cover" if again else "lost"
        yield f"not used {found.lost}"
        yield f"rss {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB"

    print("  ".join(texts()), flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=list(CLIPS))
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--pace", default="real")
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--set", nargs="*", default=[], type=lambda text: text.split("="), help="FIELD=NUMBER ...")
    parser.add_argument("--budget-s", type=float, default=0.18)
    parser.add_argument("--views-hz", type=float, default=5.0)
    parser.add_argument("--cover-s", type=float, default=0.0)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--camera", choices=("fixed", "moving"), default="fixed")
    parser.add_argument("--no-offline", action="store_true")
    parser.add_argument("--no-instruments", action="store_true")
    return parser


if __name__ == "__main__":
    main()
