"""`follow` reads a live source and follows it with a model, on this machine; a `LiveScene` shows now and the past."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import replace
from numbers import Real
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from intrasplat.camera import Intrinsics
from intrasplat.errors import InputError, IntrasplatError, UnavailableError
from intrasplat.intake.calibration.text import checked_calibration
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.live.cut import Cut
from intrasplat.live.feed import Feed, FeedSettings
from intrasplat.live.looking import FeedMoment
from intrasplat.live.spec import FIELD, FeedLayout, RecordingSpec, SourceSpec
from intrasplat.live.state import FeedReason, FeedState, LiveReport
from intrasplat.live.times import FeedTime
from intrasplat.names import DeviceName
from intrasplat.reconstruction import AnyPose, lens_of, world_from_camera_of
from intrasplat.recording import FilePath
from intrasplat.splat.backend import Device, choose_device
from intrasplat.view.frame import View
from intrasplat.view.render import render_frame

RECORDING, SEGMENTS = "recording", "segments"
"""Folders in `out`."""
CALIBRATION = "calibration"
POLL_S = 0.1
OF_THE_INPUT = (
    FeedReason.UNDECODABLE, FeedReason.NO_VIDEO, FeedReason.SIZE_CHANGED, FeedReason.PACKING_CHANGED,
    FeedReason.PACKING_UNKNOWN, FeedReason.PICTURE_LIMIT, FeedReason.REDIRECTED, FeedReason.HOST_REFUSED,
    FeedReason.NO_SCENE, FeedReason.END_OF_FILE,
)  # fmt: skip
"""Reasons for which a source cannot be used as it is. For others it may come back by itself."""
REMEDIES = {
    FeedReason.REDIRECTED: "Give the address to which it leads.",
    FeedReason.PACKING_UNKNOWN: "Name the layout of its eyes.",
    FeedReason.NO_SCENE: "Give a source whose two eyes show the same scene, and its own calibration.",
    FeedReason.END_OF_FILE: "Give a longer file.",
}
"""What to do about such a source, if more is known than to give another one."""


class LiveScene:
    """A live source that a model follows, to be shown at any moment that is stored. `follow` returns it.

    feed: the feed itself, for all that is not here (intrasplat/live/feed.py)
    """

    def __init__(self, feed: Feed, device: Device) -> None:
        self.feed, self._device = feed, device

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def report(self) -> LiveReport:
        """State with reason, rates, the model's age and size, and what can be looked at."""
        return self.feed.report()

    def wait(self, timeout_s: float = 10.0) -> bool:
        """Wait until there is something to show. False: not in time, or the source ended without a pair; report() says
        why."""
        deadline_s = time.monotonic() + timeout_s
        while self.feed.wait_for_newer(float("-inf"), min(max(deadline_s - time.monotonic(), 0.0), POLL_S)) is None:
            report = self.report()
            if time.monotonic() >= deadline_s or (report.state is FeedState.ENDED and report.segment is None):
                return False
        return True

    def moment(self, t: str | float = "live") -> FeedMoment:
        """The moment of a time, with its age and source time; raises as view()."""
        found = self.feed.moment(FeedTime.parse(t if isinstance(t, str | Real) else repr(t)))
        if found is None:
            raise self.why_unknown() or InputError("t", "nothing is known yet.", "Wait until wait() answers True.")
        return found

    def view(
        self,
        t: str | float = "live",
        pose: AnyPose = None,
        *,
        width: int | None = None,
        height: int | None = None,
        intrinsics: Intrinsics | None = None,
        detail: Literal["on", "off"] = "on",
    ) -> View:
        """The tissue at a time from a pose, instruments removed.

        Args:
            t: "live", seconds before live below 0, seconds of the source, or a time of day as RFC 3339. A moment of
                which nothing is known becomes the nearest known one, with a warning.
            pose, width, height, intrinsics, detail: as for Scene.render.

        Raises:
            InputError: the time lies before the stored past, nothing is known yet, or the pose or size cannot be used;
                or the source or its calibration cannot, so that nothing is known.
            UnavailableError: nothing is known because nothing came from the source, or it cannot be followed now.
        """
        found = self.moment(t)
        scene, pose_mm = found.scene, world_from_camera_of(found.scene, pose)
        camera = intrinsics or lens_of(scene, width, height)
        view = render_frame(scene, found.t, pose_mm, camera, self._device, detail=detail)
        return replace(view, warnings=(*found.notices, *view.warnings))

    def cut(self, from_s: float, to_s: float, path: FilePath) -> Cut:
        """The recorded video of [from_s, to_s] in seconds of the source, as it came in: a clip to reconstruct.

        It begins and ends at key frames near these times; the last seconds may be missing (docs/live.md).

        Raises:
            InputError: nothing of this range is recorded (`follow` records if it has `out`), or the path is unusable.
            OSError: the file cannot be made, such as on a full disk.
        """
        if not Path(path).parent.is_dir():
            raise InputError("path", f"there is no folder {os.fspath(Path(path).parent)!r}.", "Name another file.")
        return self.feed.cut(from_s, to_s, Path(path))

    def why_unknown(self) -> IntrasplatError | None:
        """Why nothing is known of a source yet; None: it has just begun, or is paused or closed."""
        if (error := self.feed.error) is not None:
            return error
        report = self.report()
        if report.state is FeedState.NO_TISSUE:
            return InputError(FIELD, "its pictures show no tissue.", "Give a source that shows tissue.")
        if report.reason in (None, FeedReason.BY_HAND):
            return None
        problem = f"nothing can be learnt from it: {report.text}."
        if report.reason in OF_THE_INPUT:
            return InputError(FIELD, problem, REMEDIES.get(report.reason, "Give another source."))
        return UnavailableError(f"{FIELD}: {problem}", "Start or mend the source, or try again later.", may_return=True)

    def pause(self) -> None:
        """Read, learn and store nothing from now on."""
        self.feed.pause()

    def resume(self) -> None:
        """Go on at the source's present."""
        self.feed.resume()

    def close(self) -> None:
        """End it. What is in `out` stays."""
        self.feed.close()


def follow(
    source: str,
    calibration: FilePath | Mapping[str, Any],
    *,
    out: FilePath | None = None,
    layout: FeedLayout = "auto",
    width: int | None = None,
    keep_s: float = 120.0,
    camera: Literal["fixed", "moving"] = "fixed",
    device: DeviceName = "auto",
    finds_tissue: bool = True,
) -> LiveScene:
    """Follow a live source from now on, until the result is closed: `with follow(...) as live`.

    Args:
        source: a URL, a file that is played in real time, or a capture device (docs/live.md).
        calibration: of both eyes: a file, or the values of our JSON (docs/input.md).
        out: folder in which the video is recorded and the past is stored; an earlier run's is continued. None:
            the past is in memory, and nothing is recorded.
        layout: how the two eyes lie in the pictures.
        width: of the model's pictures, px; None: as large as the machine keeps up with.
        keep_s: seconds of the past that can be viewed and cut out.
        camera: "moving": the endoscope's motion is separated from the tissue's.
        device: auto, cpu or cuda.
        finds_tissue: whether nothing is learnt, shown or stored while the pictures show no tissue.

    Raises:
        InputError: the source or the calibration cannot be used.
        UnavailableError: the device is missing.
    """
    chosen = choose_device(device)
    folder = None if out is None else Path(out)
    recording = None if folder is None else RecordingSpec(folder / RECORDING, keep_s=keep_s)
    settings = FeedSettings(
        width=width,
        camera=camera,
        keep_s=keep_s,
        segments=None if folder is None else folder / SEGMENTS,
        finds_tissue=finds_tissue,
    )
    spec = SourceSpec(source, layout=layout, recording=recording)
    try:
        return LiveScene(Feed(spec, _calibration(calibration), settings, chosen), chosen)
    except OSError as error:
        raise InputError("out", f"{out} cannot be used ({error.strerror}).", "Name another folder.") from error


def _calibration(given: FilePath | Mapping[str, Any]) -> StereoCalibration | Path:
    if isinstance(given, Mapping):
        return checked_calibration(dict(given))
    if not Path(given).is_file():
        raise InputError(CALIBRATION, f"there is no {os.fspath(given)!r}.", "Name a file that is there.")
    return Path(given)
