"""Interlaced video: finds frames whose rows are of two moments, whatever the container says, and deinterlaces them.

Two fields in one frame comb wherever something moves: rows stand out from both neighbours. In film that was telecined
to video (3:2), two of five frames comb. A field's moment within its frame follows from the frame before.

Symbols: T frames, H W pixels, w columns of all strips.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Literal

import av
import av.error
import av.filter
import cv2
import numpy as np
from numpy.typing import NDArray

FieldOrder = Literal["tff", "bff"]
"""Top field first, or bottom field first. The top field has the rows 0, 2, 4 and so on."""

STRIP, STRIPS = 8, 12
"""Width and number of the strips, spread over the picture, that are looked at."""
ALL_STRIPS = 1 << 16
"""More than any picture has."""
BLOCK_ROWS = 16
"""A block is as wide as a strip."""
COMB_LEVELS = 9
"""A pixel combs if it differs by more from both vertical neighbours, in one direction (fieldmatch: cthresh)."""
COMBED_PIXELS = 0.3
"""A block combs from this share of its pixels on (FFmpeg's filter fieldmatch: combpel 80 of 256)."""
COMBED_BLOCKS = 0.004
"""A frame combs from this share of its blocks on."""
MIN_FRAMES = 2
MIN_SHARE = 0.1
"""A video with fewer combed frames is taken as progressive."""
WHOLE_SHARE = 0.6
"""From this share on every frame is deinterlaced, else combed frames alone: telecined film has two of five."""
CLEAR_ORDER = 1.05
"""The wrong order of fields must comb by this factor more, or a frame says nothing about the order."""
AGREEING = 0.8
"""Share of such frames that must agree: noise combs, but it has no order."""

_TICK = Fraction(1, 1000)  # any: the filter only passes times on

Luma = NDArray[np.uint8]
"""[H, w], strips side by side."""


@dataclass(frozen=True)
class Interlacing:
    """The order of a video's fields, and the frames to deinterlace."""

    order: FieldOrder
    frames: frozenset[int]


@dataclass
class CombMeter:
    """Looks at the frames of a video in order. strips: the most strips to look at."""

    strips: int = STRIPS
    combed: list[int] = field(default_factory=list)
    count: int = 0
    _orders: dict[FieldOrder, int] = field(default_factory=lambda: {"tff": 0, "bff": 0})
    _before: Luma | None = None

    def add(self, frame: av.VideoFrame) -> None:
        """Look at the next frame."""
        luma = luma_of(frame, self.strips)
        if combs(luma):
            self.combed.append(self.count)
            order = None if self._before is None else _order(self._before, luma)
            if order is not None:
                self._orders[order] += 1
        self._before, self.count = luma, self.count + 1

    def interlacing(self) -> Interlacing | None:
        """What to deinterlace; None: the frames are progressive."""
        order: FieldOrder = max(self._orders, key=self._orders.__getitem__)
        agreeing, clear = self._orders[order], sum(self._orders.values())
        if len(self.combed) < max(MIN_FRAMES, MIN_SHARE * self.count) or agreeing < max(1, AGREEING * clear):
            return None
        whole = len(self.combed) >= WHOLE_SHARE * self.count
        return Interlacing(order, frozenset(range(self.count) if whole else self.combed))


def deinterlaced(frames: Iterable[av.VideoFrame], interlacing: Interlacing) -> Iterator[av.VideoFrame]:
    """The frames, all of one size and format. Those that `interlacing` names are rebuilt from their first field by
    FFmpeg's bwdif."""
    graph: av.filter.Graph | None = None
    waiting: deque[tuple[int, av.VideoFrame]] = deque()
    for index, frame in enumerate(frames):
        graph = graph or _bwdif(frame, interlacing.order)
        waiting.append((index, frame))
        graph.vpush(frame)
        yield from _rebuilt(graph, waiting, interlacing)
    if graph is not None:
        graph.vpush(None)
        yield from _rebuilt(graph, waiting, interlacing)


def _bwdif(frame: av.VideoFrame, order: FieldOrder) -> av.filter.Graph:
    graph = av.filter.Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=_TICK)
    graph.link_nodes(source, graph.add("bwdif", f"mode=send_frame:parity={order}:deint=all"), graph.add("buffersink"))
    graph.configure()
    return graph


def _rebuilt(
    graph: av.filter.Graph, waiting: deque[tuple[int, av.VideoFrame]], interlacing: Interlacing
) -> Iterator[av.VideoFrame]:
    """The frames that the filter has finished: it needs the next one for each, and gives one for one."""
    while True:
        try:
            rebuilt = graph.vpull()
        except (av.error.BlockingIOError, av.error.EOFError):
            return
        index, original = waiting.popleft()
        yield rebuilt if index in interlacing.frames else original


def luma_of(frame: av.VideoFrame, strips: int) -> Luma:
    """Strips of the first plane, in 8 bits."""
    plane, bits = frame.planes[0], frame.format.components[0].bits
    values: NDArray[Any] = np.frombuffer(memoryview(plane), np.uint8 if bits == 8 else np.uint16)
    count, item = min(strips, plane.width // STRIP), values.itemsize
    steps = plane.line_size, plane.width // count * item, item
    shown = np.lib.stride_tricks.as_strided(values, (plane.height, count, STRIP), steps, writeable=False)
    flat = shown.reshape(plane.height, -1)
    return flat if bits == 8 else (flat >> (bits - 8)).astype(np.uint8)


def combs(luma: Luma) -> bool:
    """Whether a frame shows two moments."""
    above, rows, below = luma[:-2], luma[1:-1], luma[2:]
    higher = cv2.min(cv2.subtract(rows, above), cv2.subtract(rows, below))  # they saturate at 0
    lower = cv2.min(cv2.subtract(above, rows), cv2.subtract(below, rows))
    combed = cv2.threshold(cv2.max(higher, lower), COMB_LEVELS, 255, cv2.THRESH_BINARY)[1]
    blocks = max(1, combed.shape[1] // STRIP), max(1, combed.shape[0] // BLOCK_ROWS)
    shares = cv2.resize(combed, blocks, interpolation=cv2.INTER_AREA)
    return bool((shares >= 255 * COMBED_PIXELS).mean() >= COMBED_BLOCKS)


def _order(before: Luma, luma: Luma) -> FieldOrder | None:
    """The order of the fields by two consecutive frames: fields that follow each other comb least; None if unclear."""
    rows = luma.shape[0] // 2 * 2
    late_top, late_bottom = luma[:rows].copy(), before[:rows].copy()
    late_top[1::2], late_bottom[1::2] = before[1:rows:2], luma[1:rows:2]
    top_first, bottom_first = _combing(late_top), _combing(late_bottom)
    if max(top_first, bottom_first) < CLEAR_ORDER * min(top_first, bottom_first):
        return None
    return "tff" if top_first < bottom_first else "bff"


def _combing(luma: Luma) -> float:
    """How far rows stand out from their neighbours: the sum of |second differences| down the columns."""
    rows = luma.astype(np.int16)
    return float(np.abs(rows[:-2] + rows[2:] - 2 * rows[1:-1]).sum())
