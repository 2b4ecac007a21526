"""The first pass over a video: counts, times and checks its frames. The header alone tells none of it reliably.

Symbols: T frames, D decoded frames, H W pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av

from intrasplat.clip.damage import PacketLog, Shown, frames_to_show
from intrasplat.clip.fields import ALL_STRIPS, STRIPS, CombMeter, Interlacing, deinterlaced
from intrasplat.clip.frame_times import frame_times
from intrasplat.clip.types import RgbFrame
from intrasplat.clip.video import CachedFrames, VideoFile
from intrasplat.clip.video_stream import RgbConverter, count_packets, decoded, open_stream
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.video_header import CODECS, REMEDY, check_video
from intrasplat.notices import Notice, NoticeCode

MAX_MISSING_FRAMES = 1  # an mp4's table may count one more
MAX_DAMAGED = 0.5
"""A video of which more is damaged is refused."""
MAX_PIXEL_ASPECT = 4.0
"""Wider or narrower pixels are a mistake of the container."""

_DAMAGE_REMEDY = "The file is cut short or damaged: copy or export it again."


@dataclass
class _Pass:
    """What the first pass over a video finds, and how its frames are shaped."""

    comb: CombMeter
    times: list[int | None] = field(default_factory=list)
    corrupt: list[int] = field(default_factory=list)
    log: PacketLog = field(default_factory=PacketLog)
    cached: CachedFrames | None = field(default_factory=CachedFrames)
    rotation_deg: int = 0
    coded_interlaced: bool = False


def survey(path: Path, field: str, limits: ClipLimits, label: str) -> VideoFile:
    """The video, after one pass over all its frames. Raises as open_video."""
    track = check_video(path, field, label, limits)
    with open_stream(path, limits) as stream:
        if stream is None:
            problem = f"{label} cannot be decoded: it is damaged, or its codec is none of {', '.join(CODECS)}."
            raise InputError(field, problem, REMEDY)
        width, height, declared = stream.codec_context.width, stream.codec_context.height, stream.frames
        codec = stream.codec_context.codec.name
        limits.check_frame(field, label, width, height)
        limits.check_clip(field, label, declared, width, height)
        found = _read(stream, field, limits, label)
        unit_s, rate_hz = stream.time_base or Fraction(1), stream.average_rate or stream.guessed_rate
        aspect = float(stream.sample_aspect_ratio or 1)
        aspect = aspect if 1 / MAX_PIXEL_ASPECT <= aspect <= MAX_PIXEL_ASPECT else 1.0
    _check_whole(path, field, limits, label, found, declared)
    shown = frames_to_show(found.times, found.corrupt, found.log, one_to_one=codec != "vp9")  # VP9 has hidden frames
    _check_damage(shown, field, label)
    stamps_s = [None if time is None else float(time * unit_s) for time in shown.times]
    times_s, notices = frame_times(stamps_s, None if rate_hz is None else float(rate_hz), field)
    limits.check_duration(field, label, 0.0 if times_s is None else float(times_s[-1]))
    interlacing = found.comb.interlacing()
    if aspect != 1:
        text = f"{field}: pixels are {aspect:.4g} times as wide as high and are kept so; a calibration of square pixels"
        notices = (*notices, Notice.info(NoticeCode.PIXEL_ASPECT, f"{text} is scaled to them"))
    if not track.is_bounded:
        unknown = f"{field}: the video names no frame count, a missing end would not be noticed"
        notices = (*notices, Notice.warning(NoticeCode.FRAME_COUNT_UNKNOWN, unknown))
    return VideoFile(
        path=path,
        field=field,
        label=label,
        height=height,
        width=width,
        frame_times_s=times_s,
        limits=limits,
        sources=shown.sources,
        damaged=shown.damaged,
        pixel_aspect=aspect,
        interlacing=interlacing,
        notices=(*notices, *_notices(found, shown, interlacing, field)),
        cached=found.cached if interlacing is None else None,
    )


def rgb_frames(video: VideoFile) -> Iterator[RgbFrame]:
    """The decoded frames of a surveyed video, deinterlaced where its survey says so, RGB uint8 [H, W, 3] each."""
    with open_stream(video.path, video.limits) as stream:
        if stream is None:
            return
        convert = RgbConverter(video.field, video.label)
        frames = _of_one_size(decoded(stream, PacketLog()), video.field, video.label)
        for frame in frames if video.interlacing is None else deinterlaced(frames, video.interlacing):
            yield convert(frame)


def _read(stream: av.VideoStream, field: str, limits: ClipLimits, label: str) -> _Pass:
    comb = CombMeter(ALL_STRIPS if field == "masks" else STRIPS)  # of masks only edges comb
    found, convert = _Pass(comb), RgbConverter(field, label)
    for frame in _of_one_size(decoded(stream, found.log), field, label):
        if not found.times:
            found.rotation_deg = frame.rotation
        found.coded_interlaced |= frame.interlaced_frame
        if frame.is_corrupt:
            found.corrupt.append(len(found.times))
        found.times.append(frame.pts)
        found.comb.add(frame)
        limits.on_picture()
        limits.check_clip(field, label, len(found.times), frame.width, frame.height)
        if found.cached is not None and not found.cached.add(convert(frame)):
            found.cached = None
    return found


def _of_one_size(frames: Iterator[av.VideoFrame], field: str, label: str) -> Iterator[av.VideoFrame]:
    first: av.VideoFrame | None = None
    for index, frame in enumerate(frames):
        first = first or frame
        if (frame.width, frame.height) != (first.width, first.height):
            raise InputError(
                field,
                f"frame {index} of {label} is {frame.width}x{frame.height} pixels, "
                f"the first is {first.width}x{first.height}.",
                "Encode the clip in one size.",
            )
        yield frame if frame.format.name == first.format.name else frame.reformat(format=first.format.name)


def _check_whole(path: Path, field: str, limits: ClipLimits, label: str, found: _Pass, declared: int) -> None:
    """InputError if a video has fewer packets than its table of `declared` frames.

    An mp4 that was cut without re-encoding has frames outside its edit list, which count.
    """
    packets = len(found.log.samples)
    if found.times and packets + MAX_MISSING_FRAMES < declared:
        with open_stream(path, limits, with_hidden=True) as stream:
            packets = 0 if stream is None else count_packets(stream)
    if not found.times or packets + MAX_MISSING_FRAMES < declared:
        named = declared or len(found.log.samples)
        problem = f"{label} ends after {len(found.times)} frames; its header says {named}."
        raise InputError(field, problem, _DAMAGE_REMEDY)


def _check_damage(shown: Shown, field: str, label: str) -> None:
    if len(shown.damaged) > MAX_DAMAGED * len(shown.times):
        problem = f"{len(shown.damaged)} of the {len(shown.times)} frames of {label} are damaged."
        raise InputError(field, problem, _DAMAGE_REMEDY)


def _notices(found: _Pass, shown: Shown, interlacing: Interlacing | None, field: str) -> tuple[Notice, ...]:
    notices = []
    if shown.damaged:
        text = f"{field}: frames {_runs(shown.damaged)} of {len(shown.times)} are damaged and were left out"
        notices.append(Notice.warning(NoticeCode.DAMAGED_FRAMES, text))
    if found.rotation_deg % 360:
        text = f"{field}: players turn this video by {found.rotation_deg % 360} degrees; its frames are used as"
        notices.append(Notice.info(NoticeCode.ROTATION, f"{text} recorded, as calibration and masks show them"))
    if interlacing is not None:
        which = "all frames show" if len(interlacing.frames) == len(found.times) else "some frames show"
        count = f"{len(interlacing.frames)} of {len(found.times)}"
        text = f"{field}: interlaced video, {which} two moments in alternate rows: {count} were deinterlaced"
        notices.append(Notice.info(NoticeCode.INTERLACED, text))
    elif found.coded_interlaced:
        text = f"{field}: coded as interlaced, but each frame shows one moment: used as they are"
        notices.append(Notice.info(NoticeCode.INTERLACED, text))
    return tuple(notices)


def _runs(indices: Sequence[int]) -> str:
    """Rising numbers as text: 3 to 7, 9."""
    runs: list[list[int]] = []
    for index in indices:
        if runs and index == runs[-1][-1] + 1:
            runs[-1][1:] = [index]
        else:
            runs.append([index])
    return ", ".join(" to ".join(map(str, run)) for run in runs)
