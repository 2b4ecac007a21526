"""Encode and decode tables of integers with an adaptive binary range coder like that of LZMA.

Symbols: N Gaussians, K rows of integers with one integer per Gaussian; a table is [N, K].

Each number is coded as bits: how many binary digits its magnitude has (that many ones, then a zero), its sign, and the
digits below the leading one, from the top. The sign and the third and later of these digits are direct bits, which cost
one bit each. Every other bit has an adaptive probability. A row has BUCKETS sets of probabilities. The activity chooses
the set: how large, for their rows, the last numbers of this Gaussian and of this row were, because large motion occurs
together. All arithmetic is on integers, so a table has the same code on every machine. docs/scene-file.md describes the
code for other readers.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from intrasplat.machine.cache import kernel

Table = NDArray[np.int32]

PARTS = 4
"""Number of tables of neighbouring rows into which a table is split, to code them independently and in parallel."""
MAX_MAGNITUDE = 2**30 - 1
"""The largest magnitude of 30 binary digits."""
BUCKETS = 10
"""Sets of probabilities per row, by activity."""
MODELS = 33 + 31 + 2 * 31
"""Probabilities in a set: of the digit count, of the second digit by that count, of the third by count and second."""
SECOND, THIRD = 33, 33 + 31
ONE = 1 << 16
"""Probability 1. A probability of a 0 is the mean of a fast and a slow estimate, in units of 1 / ONE."""
QUICK, SLOW = 4, 7
MAX_BIT_COST = 10
"""Most bits of code that one bit with a probability takes: `it >> k` is 0 below 2**k, so estimates stay 15 and 127 away
from 0 and ONE, their mean 71, and log2(ONE / 71) is 9.85; rounding a range of at least 2**24 adds less than 0.01."""
AVERAGE = 64
"""Activity of a number as large as its row's average."""
MAX_ACTIVITY = 6 * AVERAGE
THRESHOLDS = np.array([14, 21, 31, 46, 69, 103, 154, 231, 346])
"""Activities at which the next bucket starts: each 1.5 times the one before, rounded down."""
_BUCKET_OF = np.searchsorted(THRESHOLDS, np.arange(MAX_ACTIVITY + 1), side="right")
_TOP = np.uint64(1 << 24)
_FULL = np.uint64(0xFFFFFFFF)
_BYTE = np.uint64(8)


def encode(table: Table) -> list[bytes]:
    """The codes of the table's PARTS parts.

    Raises:
        ValueError: a number's magnitude exceeds MAX_MAGNITUDE.
    """
    largest = max(abs(int(table.min())), abs(int(table.max()))) if table.size else 0
    if largest > MAX_MAGNITUDE:
        raise ValueError(f"numbers up to {largest} cannot be coded")
    digits = largest.bit_length()
    # a number is at most digits + 3 bits with a probability (count, closing 0, two digits) and digits direct bits
    max_bits = MAX_BIT_COST * (digits + 3) + digits

    def coded(part: Table) -> bytes:
        out = np.zeros(64 + part.size * max_bits // 8, np.uint8)  # untouched pages take no memory
        return out[: _encode(part, out)].tobytes()

    with ThreadPoolExecutor(PARTS) as pool:
        return list(pool.map(coded, np.array_split(table, PARTS, axis=1)))


def decode(codes: list[bytes], count: int, rows: int) -> Table:
    """The table [count, rows] that encode() was given.

    Raises:
        ValueError: there are not PARTS codes, or one is too short, too long, or not written by encode().
    """
    if len(codes) != PARTS:
        raise ValueError(f"there are {len(codes)} codes instead of {PARTS}")
    table = np.zeros((count, rows), np.int32)
    parts = np.array_split(table, PARTS, axis=1)
    with ThreadPoolExecutor(PARTS) as pool:
        sizes = pool.map(lambda code, part: _decode(np.frombuffer(code, np.uint8), part), codes, parts)
        for code, size in zip(codes, sizes, strict=True):
            if size != len(code):
                raise ValueError(f"a code of {len(code)} bytes does not end where its numbers do")
    return table


@kernel
def _encode(table, out):  # type: ignore[no-untyped-def]
    """Encode a table into out; return the number of bytes written."""
    count, rows = table.shape
    models, average, nearby = _initial_models(rows)
    # low, the range's width, bytes written (the first is 0); passed as plain numbers, as an array would be slower
    state = np.uint64(0), _FULL, 1
    for n in range(count):
        here = AVERAGE
        for k in range(rows):
            number = table[n, k]
            magnitude = abs(number)
            first = _first_model(k, here, nearby)
            digits = 0
            while magnitude >> digits:
                state = _encode_bit(state, out, models, first + digits, 1)
                digits += 1
            state = _encode_bit(state, out, models, first + digits, 0)
            if digits:
                state = _encode_direct_bit(state, out, number < 0)
            for digit in range(digits - 2, -1, -1):
                bit = (magnitude >> digit) & 1
                model = _digit_model(digits, digit, magnitude)
                if model:
                    state = _encode_bit(state, out, models, first + model, bit)
                else:
                    state = _encode_direct_bit(state, out, bit)
            here = _update_activity(magnitude, here, average, nearby, k)
    for _ in range(4):
        state = _shift_low(state, out)
    return state[2]


@kernel
def _decode(code, table):  # type: ignore[no-untyped-def]
    """Decode a table; return the number of bytes that its encoder wrote, or -1 if no encoder wrote this code."""
    count, rows = table.shape
    models, average, nearby = _initial_models(rows)
    state = np.uint64(0), _FULL, np.int64(0)  # the code less low, the range's width, bytes read
    for _ in range(5):
        state = _read_byte(state, code)
    for n in range(count):
        here = AVERAGE
        for k in range(rows):
            first = _first_model(k, here, nearby)
            digits = 0
            while digits < 31:
                state, bit = _decode_bit(state, code, models, first + digits)
                if not bit:
                    break
                digits += 1
            if digits > 30 or state[2] > len(code):
                return -1
            magnitude, negative = 0, 0
            if digits:
                magnitude = 1
                state, negative = _decode_direct_bit(state, code)
            for digit in range(digits - 2, -1, -1):
                model = _digit_model(digits, digit, magnitude << (digit + 1))
                if model:
                    state, bit = _decode_bit(state, code, models, first + model)
                else:
                    state, bit = _decode_direct_bit(state, code)
                magnitude = 2 * magnitude + bit
            table[n, k] = -magnitude if negative else magnitude
            here = _update_activity(magnitude, here, average, nearby, k)
    return state[2]


@kernel
def _initial_models(rows):  # type: ignore[no-untyped-def]
    """Probabilities [rows * BUCKETS * MODELS, 2]; each row's average magnitude * 256; each row's activity."""
    models = np.full((rows * BUCKETS * MODELS, 2), ONE // 2, np.uint16)  # they stay below ONE
    return models, np.full(rows, 256, np.int64), np.full(rows, AVERAGE, np.int64)


@kernel
def _first_model(k, here, nearby):  # type: ignore[no-untyped-def]
    """Index of the first probability of row k's set, chosen by activity."""
    return (k * BUCKETS + _BUCKET_OF[(3 * here + nearby[k]) >> 2]) * MODELS


@kernel
def _digit_model(digits, digit, magnitude):  # type: ignore[no-untyped-def]
    """Offset of this digit's probability in the set; 0: a direct bit. Only magnitude's digits above this one count."""
    if digit == digits - 2:
        return SECOND + digits
    if digit == digits - 3:
        return THIRD + 2 * digits + ((magnitude >> (digits - 2)) & 1)
    return 0


@kernel
def _update_activity(magnitude, here, average, nearby, k):  # type: ignore[no-untyped-def]
    """Update row k's average and activity with a number; return the Gaussian's new activity."""
    average[k] += ((magnitude << 8) - average[k]) >> 7
    activity = 0
    if magnitude:  # most are 0, and the division is the slowest step here
        activity = min((magnitude << 14) // (average[k] + AVERAGE), MAX_ACTIVITY)
    nearby[k] += (activity - nearby[k]) >> 3
    return here + ((activity - here) >> 3)


@kernel
def _update_probability(models, at, bit):  # type: ignore[no-untyped-def]
    """Move both estimates of the probability of a 0 towards this bit."""
    quick, slow = np.int64(models[at, 0]), np.int64(models[at, 1])
    if bit:
        quick, slow = quick - (quick >> QUICK), slow - (slow >> SLOW)
    else:
        quick, slow = quick + ((ONE - quick) >> QUICK), slow + ((ONE - slow) >> SLOW)
    models[at, 0], models[at, 1] = quick, slow


@kernel
def _bound(width, models, at):  # type: ignore[no-untyped-def]
    """Where a bit splits the range: 0 takes the part below, 1 the part above."""
    return (width >> np.uint64(16)) * np.uint64((np.int64(models[at, 0]) + np.int64(models[at, 1])) >> 1)


@kernel
def _encode_bit(state, out, models, at, bit):  # type: ignore[no-untyped-def]
    state = _narrow(state, out, _bound(state[1], models, at), bit)
    _update_probability(models, at, bit)
    return state


@kernel
def _encode_direct_bit(state, out, bit):  # type: ignore[no-untyped-def]
    return _narrow(state, out, state[1] >> np.uint64(1), bit)


@kernel
def _narrow(state, out, bound, bit):  # type: ignore[no-untyped-def]
    """Narrow the range to the bit's part and write the bytes that can no longer change."""
    low, width, place = state
    if bit:
        low += bound
        width -= bound
        if low > _FULL:
            _propagate_carry(out, place)
            low &= _FULL
    else:
        width = bound
    while width < _TOP:
        low, width, place = _shift_low((low, width << _BYTE, place), out)
    return low, width, place


@kernel
def _propagate_carry(out, place):  # type: ignore[no-untyped-def]
    """Add 1 to the bytes written so far, read as one number; the first byte starts at 0, so it cannot overflow."""
    place -= 1
    while out[place] == 255:
        out[place] = 0
        place -= 1
    out[place] += 1


@kernel
def _shift_low(state, out):  # type: ignore[no-untyped-def]
    """Write low's top byte and shift it out."""
    low, width, place = state
    out[place] = np.uint8(low >> np.uint64(24))
    return (low << _BYTE) & _FULL, width, place + 1


@kernel
def _decode_bit(state, code, models, at):  # type: ignore[no-untyped-def]
    state, bit = _compare(state, code, _bound(state[1], models, at))
    _update_probability(models, at, bit)
    return state, bit


@kernel
def _decode_direct_bit(state, code):  # type: ignore[no-untyped-def]
    return _compare(state, code, state[1] >> np.uint64(1))


@kernel
def _compare(state, code, bound):  # type: ignore[no-untyped-def]
    """The new state, and the bit: 1 where the code lies at or above the bound."""
    above, width, place = state
    bit = 0
    if above >= bound:
        above -= bound
        width -= bound
        bit = 1
    else:
        width = bound
    while width < _TOP:
        above, width, place = _read_byte((above, width << _BYTE, place), code)
    return (above, width, place), bit


@kernel
def _read_byte(state, code):  # type: ignore[no-untyped-def]
    """Append the next byte of the code, or 0 behind its end."""
    above, width, place = state
    byte = np.uint64(code[place]) if place < len(code) else np.uint64(0)
    return ((above << _BYTE) | byte) & _FULL, width, place + 1
