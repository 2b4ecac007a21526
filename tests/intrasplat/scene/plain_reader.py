"""Another reader of compact scenes in plain Python, written from docs/scene-file.md alone.

It is slow and for tests only. Where it and intrasplat/scene/compact.py differ, one of them or the page is wrong.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

GROUPS = 3
PLAIN = 3
"""Group of the columns whose powers are 0."""


@dataclass
class PlainScene:
    """Of each Gaussian: its 14 numbers at rest, its motion's weights [C][B], and seen."""

    state: list[list[float]]
    weight: list[list[list[float]]]
    seen: list[float]


def read_plainly(directory: Path) -> PlainScene:
    manifest = json.loads((directory / "manifest.json").read_text())
    assert manifest["coding"] == "compact"
    tensors = tensors_of((directory / "scene.safetensors").read_bytes())
    (count,), (_, step), (_, shared) = tensors["count"][1], tensors["step"], tensors["shared"]
    (channels, patterns, _), _ = tensors["pattern"]
    group = group_of_column(channels, patterns)
    table = told_table([bytes(tensors[f"code.{part}"][1]) for part in range(4)], count, len(group))
    undo_differences(table, shared, group)
    state = [
        colours([row[c] * 2.0 ** -row[-4 + group[c]] * step[c] for c in range(14)], slice(10, 13)) for row in table
    ]
    return PlainScene(
        state, [weights(row, tensors["pattern"], group) for row in table], [row[-1] / 63 for row in table]
    )


def tensors_of(content: bytes) -> dict[str, tuple[list[int], list[Any]]]:
    """Shape and numbers of each tensor of a safetensors file."""
    (length,) = struct.unpack_from("<Q", content)
    letters = {"F32": "f", "I64": "q", "U8": "B"}
    found = {}
    for name, entry in json.loads(content[8 : 8 + length]).items():
        first, last = (8 + length + offset for offset in entry["data_offsets"])
        letter = letters[entry["dtype"]]
        numbers = struct.unpack(f"<{(last - first) // struct.calcsize(letter)}{letter}", content[first:last])
        found[name] = (entry["shape"], list(numbers))
    return found


def group_of_column(channels: int, patterns: int) -> list[int]:
    of_state = [0] * 3 + [1] * 7 + [2] * 4
    of_motion = [of_state[channel] for channel in range(channels) for _ in range(patterns)]
    return of_state + of_motion + [PLAIN] * 4


def told_table(codes: list[bytes], count: int, columns: int) -> list[list[int]]:
    """The table's rows in the Gaussians' order, as they are told."""
    short, longer = divmod(columns, 4)
    parts = [Decoder(code).rows(count, short + (part < longer)) for part, code in enumerate(codes)]
    told = [[number for part in parts for number in part[place]] for place in range(count)]
    order = [0, *(i for level in reversed(levels(count)) for i in level[1::2])]
    table: list[list[int]] = [[] for _ in range(count)]
    for place, i in enumerate(order):
        table[i] = told[place]
    return table


def levels(count: int) -> list[list[int]]:
    every = [list(range(count))]
    while len(every[-1]) > 1:
        every.append(every[-1][::2])
    return every


def undo_differences(table: list[list[int]], shared: list[int], group: list[int]) -> None:
    for plain in (True, False):
        for level in reversed(levels(len(table))):
            for place in range(1, len(level), 2):
                left = level[place - 1]
                right = level[place + 1] if place + 1 < len(level) else left
                for k, which in enumerate(group):
                    if shared[k] and (which == PLAIN) == plain:
                        a, b, own = (table[i][k] for i in (left, right, level[place]))
                        p, q, s = (0 if plain else table[i][-4 + which] for i in (left, right, level[place]))
                        mean = ((a << (4 - p)) + (b << (4 - q)) + (1 << (4 - s))) >> (5 - s)
                        table[level[place]][k] = own + mean


def weights(row: list[int], pattern: tuple[list[int], list[float]], group: list[int]) -> list[list[float]]:
    (channels, patterns, bases), numbers = pattern
    weight = [[0.0] * bases for _ in range(channels)]
    for channel in range(channels):
        for r in range(patterns):
            q = row[14 + channel * patterns + r] * 2.0 ** -row[-4 + group[channel]]
            for b in range(bases):
                weight[channel][b] += q * numbers[(channel * patterns + r) * bases + b]
    if channels == 13:
        mixed = [colours([weight[channel][b] for channel in range(10, 13)], slice(0, 3)) for b in range(bases)]
        weight[10:] = [[mixed[b][c] for b in range(bases)] for c in range(3)]
    return weight


def colours(numbers: list[float], where: slice) -> list[float]:
    """Brightness, red - blue and magenta - green there as red, green and blue."""
    o = ((1, 1, 1), 3), ((1, 0, -1), 2), ((1, -2, 1), 6)
    held = numbers[where]
    numbers[where] = [sum(row[c] / math.sqrt(n) * x for (row, n), x in zip(o, held, strict=True)) for c in range(3)]
    return numbers


class Decoder:
    """The range coder of one part of the table."""

    def __init__(self, code: bytes) -> None:
        self.code, self.range = code, 2**32 - 1
        self.low, self.place = int.from_bytes(code[:5], "big"), 5
        self.models: dict[tuple[int, int, int], list[int]] = {}

    def cut(self, bound: int) -> int:
        bit = int(self.low >= bound)
        if bit:
            self.low, self.range = self.low - bound, self.range - bound
        else:
            self.range = bound
        while self.range < 2**24:
            self.range, self.low, self.place = self.range * 256, self.low * 256 + self.code[self.place], self.place + 1
        return bit

    def plain(self) -> int:
        return self.cut(self.range >> 1)

    def modelled(self, column: int, bucket: int, which: int) -> int:
        model = self.models.setdefault((column, bucket, which), [32768, 32768])
        bit = self.cut((self.range >> 16) * (sum(model) >> 1))
        for each, k in enumerate((4, 7)):
            model[each] += -(model[each] >> k) if bit else (65536 - model[each]) >> k
        return bit

    def number(self, column: int, bucket: int) -> int:
        digits = 0
        while self.modelled(column, bucket, digits):
            digits += 1
        if not digits:
            return 0
        negative, magnitude = self.plain(), 1
        for below in range(1, digits):
            if below == 1:
                bit = self.modelled(column, bucket, 33 + digits)
            elif below == 2:
                bit = self.modelled(column, bucket, 64 + 2 * digits + (magnitude & 1))
            else:
                bit = self.plain()
            magnitude = 2 * magnitude + bit
        return -magnitude if negative else magnitude

    def rows(self, count: int, columns: int) -> list[list[int]]:
        average, nearby, rows = [256] * columns, [64] * columns, []
        for _ in range(count):
            here, row = 64, []
            for k in range(columns):
                activity = (3 * here + nearby[k]) >> 2
                bucket = sum(activity >= threshold for threshold in (14, 21, 31, 46, 69, 103, 154, 231, 346))
                row.append(self.number(k, bucket))
                magnitude = abs(row[-1])
                average[k] += ((magnitude << 8) - average[k]) >> 7
                a = min((magnitude << 14) // (average[k] + 64), 384)
                nearby[k] += (a - nearby[k]) >> 3
                here += (a - here) >> 3
            rows.append(row)
        assert self.place == len(self.code)
        return rows
