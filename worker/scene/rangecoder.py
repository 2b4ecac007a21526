"""Whole numbers as few bytes: an adaptive binary range coder, as LZMA's, with models that follow a table's rows.

Symbols: N Gaussians, K rows of whole numbers, one of each a Gaussian; a table is [N, K].

A number is told in bits: how many binary digits its magnitude has (that many ones, then a zero), its sign, and the
digits below the leading one, from the top. Each bit has a probability that adapts, but for the sign and the third digit
onwards, which cost a bit each. The probabilities are chosen by row, and within it by how large, for their rows, the
numbers just told of this Gaussian and the same row's of the Gaussians before were: where there is motion, there is
much of it. Everything is integer arithmetic, so a table has one coding on every machine; docs/scene-file.md has it for
whoever writes another reader.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from worker.machine.cache import kernel

Table = NDArray[np.int32]

PARTS = 4
"""A table is coded as so many tables, of neighbouring rows each, that share nothing and so may be read at once."""
LARGEST = 2**30 - 1
"""Magnitudes have at most 30 digits."""
BUCKETS = 10
"""Sets of probabilities a row, by activity."""
MODELS = 33 + 31 + 2 * 31
"""Of a set: digits told so far, the second digit by their number, the third by their number and the second."""
SECOND, THIRD = 33, 33 + 31
ONE = 1 << 16
"""Probabilities of a 0 are shares of this, each the mean of a quick and a slow estimate."""
QUICK, SLOW = 4, 7
DEAREST_BITS = 10
"""What a bit with a model costs at most: `it >> k` is 0 below 2**k, so estimates stay 15 and 127 away from 0 and ONE,
their mean 71, and log2(ONE / 71) is 9.85; cutting a range of at least 2**24 in whole numbers adds less than 0.01."""
AVERAGE = 64
"""Activity of a number as large as its row's average."""
MOST_ACTIVE = 6 * AVERAGE
THRESHOLDS = np.array([14, 21, 31, 46, 69, 103, 154, 231, 346])
"""Activities at which the next bucket begins: each half as much again, rounded down."""
_BUCKET_OF = np.searchsorted(THRESHOLDS, np.arange(MOST_ACTIVE + 1), side="right")
_TOP = np.uint64(1 << 24)
_FULL = np.uint64(0xFFFFFFFF)
_BYTE = np.uint64(8)


def encode(table: Table) -> list[bytes]:
    """The table's PARTS codes.

    Raises:
        ValueError: a number's magnitude exceeds LARGEST.
    """
    largest = max(abs(int(table.min())), abs(int(table.max()))) if table.size else 0
    if largest > LARGEST:
        raise ValueError(f"numbers up to {largest} cannot be coded")
    digits = largest.bit_length()
    # of a number: with models so many ones and a 0, and two digits; plain its sign and what digits are left
    most_bits = DEAREST_BITS * (digits + 3) + digits

    def coded(part: Table) -> bytes:
        out = np.zeros(64 + part.size * most_bits // 8, np.uint8)  # pages that stay untouched take no memory
        return out[: _encode(np.ascontiguousarray(part), out)].tobytes()

    with ThreadPoolExecutor(PARTS) as pool:
        return list(pool.map(coded, np.array_split(table, PARTS, axis=1)))


def decode(codes: list[bytes], count: int, rows: int) -> Table:
    """The table [count, rows] of these codes.

    Raises:
        ValueError: not PARTS codes, or one that ends too soon, too late, or holds what no encoder writes.
    """
    if len(codes) != PARTS:
        raise ValueError(f"there are {len(codes)} codes instead of {PARTS}")
    table = np.zeros((count, rows), np.int32)
    parts = np.array_split(table, PARTS, axis=1)
    with ThreadPoolExecutor(PARTS) as pool:
        wanted = pool.map(
            lambda each: _decode(np.frombuffer(each[0], np.uint8), each[1]), zip(codes, parts, strict=True)
        )
        for code, size in zip(codes, wanted, strict=True):
            if size != len(code):
                raise ValueError(f"a code of {len(code)} bytes does not end where its numbers do")
    return table


@kernel
def _encode(table, out):  # type: ignore[no-untyped-def]
    """Code a table into out; returns the bytes written."""
    count, rows = table.shape
    models, average, nearby = _start(rows)
    # Low; the range; bytes written, the first of them 0. Handed around as plain numbers: an array would be slower.
    state = np.uint64(0), _FULL, 1
    for n in range(count):
        here = AVERAGE
        for k in range(rows):
            number = table[n, k]
            magnitude = abs(number)
            first = _set(k, here, nearby)
            digits = 0
            while magnitude >> digits:
                state = _tell(state, out, models, first + digits, 1)
                digits += 1
            state = _tell(state, out, models, first + digits, 0)
            if digits:
                state = _tell_plain(state, out, number < 0)
            for digit in range(digits - 2, -1, -1):
                bit = (magnitude >> digit) & 1
                model = _digit_model(digits, digit, magnitude)
                if model:
                    state = _tell(state, out, models, first + model, bit)
                else:
                    state = _tell_plain(state, out, bit)
            here = _follow(magnitude, here, average, nearby, k)
    for _ in range(4):
        state = _give(state, out)
    return state[2]


@kernel
def _decode(code, table):  # type: ignore[no-untyped-def]
    """Read a table from its code; returns the bytes that the coder of this table has written, or -1."""
    count, rows = table.shape
    models, average, nearby = _start(rows)
    state = np.uint64(0), _FULL, np.int64(0)  # how far the code lies above the range's start; the range; bytes read
    for _ in range(5):
        state = _take(state, code)
    for n in range(count):
        here = AVERAGE
        for k in range(rows):
            first = _set(k, here, nearby)
            digits = 0
            while digits < 31:
                state, bit = _ask(state, code, models, first + digits)
                if not bit:
                    break
                digits += 1
            if digits > 30 or state[2] > len(code):
                return -1
            magnitude, negative = 0, 0
            if digits:
                magnitude = 1
                state, negative = _ask_plain(state, code)
            for digit in range(digits - 2, -1, -1):
                model = _digit_model(digits, digit, magnitude << (digit + 1))
                if model:
                    state, bit = _ask(state, code, models, first + model)
                else:
                    state, bit = _ask_plain(state, code)
                magnitude = 2 * magnitude + bit
            table[n, k] = -magnitude if negative else magnitude
            here = _follow(magnitude, here, average, nearby, k)
    return state[2]


@kernel
def _start(rows):  # type: ignore[no-untyped-def]
    """Probabilities [rows * BUCKETS * MODELS, 2], each row's average magnitude (of 256) and activity so far."""
    models = np.full((rows * BUCKETS * MODELS, 2), ONE // 2, np.uint16)  # they never reach ONE
    return models, np.full(rows, 256, np.int64), np.full(rows, AVERAGE, np.int64)


@kernel
def _set(k, here, nearby):  # type: ignore[no-untyped-def]
    """Where the models of this row and activity begin."""
    return (k * BUCKETS + _BUCKET_OF[(3 * here + nearby[k]) >> 2]) * MODELS


@kernel
def _digit_model(digits, digit, magnitude):  # type: ignore[no-untyped-def]
    """Which model tells the digit below the leading one; 0: none. magnitude: right in the digits above this one."""
    if digit == digits - 2:
        return SECOND + digits
    if digit == digits - 3:
        return THIRD + 2 * digits + ((magnitude >> (digits - 2)) & 1)
    return 0


@kernel
def _follow(magnitude, here, average, nearby, k):  # type: ignore[no-untyped-def]
    """After a number: its row's average and activity; returns the Gaussian's activity."""
    average[k] += ((magnitude << 8) - average[k]) >> 7
    activity = 0
    if magnitude:  # most are 0, and nothing here is slower than to divide
        activity = min((magnitude << 14) // (average[k] + AVERAGE), MOST_ACTIVE)
    nearby[k] += (activity - nearby[k]) >> 3
    return here + ((activity - here) >> 3)


@kernel
def _adapt(models, at, bit):  # type: ignore[no-untyped-def]
    quick, slow = np.int64(models[at, 0]), np.int64(models[at, 1])
    if bit:
        quick, slow = quick - (quick >> QUICK), slow - (slow >> SLOW)
    else:
        quick, slow = quick + ((ONE - quick) >> QUICK), slow + ((ONE - slow) >> SLOW)
    models[at, 0], models[at, 1] = quick, slow


@kernel
def _bound(width, models, at):  # type: ignore[no-untyped-def]
    """Where a range is cut: a 0 takes what is below."""
    return (width >> np.uint64(16)) * np.uint64((np.int64(models[at, 0]) + np.int64(models[at, 1])) >> 1)


@kernel
def _tell(state, out, models, at, bit):  # type: ignore[no-untyped-def]
    state = _cut(state, out, _bound(state[1], models, at), bit)
    _adapt(models, at, bit)
    return state


@kernel
def _tell_plain(state, out, bit):  # type: ignore[no-untyped-def]
    return _cut(state, out, state[1] >> np.uint64(1), bit)


@kernel
def _cut(state, out, bound, bit):  # type: ignore[no-untyped-def]
    low, width, place = state
    if bit:
        low += bound
        width -= bound
        if low > _FULL:
            _carry(out, place)
            low &= _FULL
    else:
        width = bound
    while width < _TOP:
        low, width, place = _give((low, width << _BYTE, place), out)
    return low, width, place


@kernel
def _carry(out, place):  # type: ignore[no-untyped-def]
    """Add 1 to the number written so far; its first byte is 0 and takes what no other can."""
    place -= 1
    while out[place] == 255:
        out[place] = 0
        place -= 1
    out[place] += 1


@kernel
def _give(state, out):  # type: ignore[no-untyped-def]
    """Move low's top byte out."""
    low, width, place = state
    out[place] = np.uint8(low >> np.uint64(24))
    return (low << _BYTE) & _FULL, width, place + 1


@kernel
def _ask(state, code, models, at):  # type: ignore[no-untyped-def]
    state, bit = _which(state, code, _bound(state[1], models, at))
    _adapt(models, at, bit)
    return state, bit


@kernel
def _ask_plain(state, code):  # type: ignore[no-untyped-def]
    return _which(state, code, state[1] >> np.uint64(1))


@kernel
def _which(state, code, bound):  # type: ignore[no-untyped-def]
    """The new state, and 1 where the code lies above the cut."""
    above, width, place = state
    bit = 0
    if above >= bound:
        above -= bound
        width -= bound
        bit = 1
    else:
        width = bound
    while width < _TOP:
        above, width, place = _take((above, width << _BYTE, place), code)
    return (above, width, place), bit


@kernel
def _take(state, code):  # type: ignore[no-untyped-def]
    """The next byte; behind the end there are zeros."""
    above, width, place = state
    byte = np.uint64(code[place]) if place < len(code) else np.uint64(0)
    return ((above << _BYTE) | byte) & _FULL, width, place + 1
