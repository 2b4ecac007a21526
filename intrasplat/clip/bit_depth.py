"""Finds how many of their 16 bits pictures use: cameras store 10, 12 or 14 bits in 16, which would come out nearly
black."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar, cast

from intrasplat.clip.images import ImageSequence
from intrasplat.clip.packing import FrameSequence
from intrasplat.intake.sniff import png_bits
from intrasplat.notices import Notice, NoticeCode

Pictures = TypeVar("Pictures", bound=FrameSequence)

USUAL_BITS = (8, 10, 12, 14, 16)
_DEEP = 16
_HEADER_BYTES = 32


def at_own_depth(*sequences: Pictures) -> tuple[Pictures, ...]:
    """The sequences, white in their 16-bit pictures being the largest number of the bits that they use, alike in all.

    The bits are the fewest of USUAL_BITS that hold the largest value of the whole clip: one dark frame decides nothing.
    If these are fewer than 16, a notice says so. Pictures are decoded until one needs all 16 bits.
    """
    largest = 0
    for sequence in sequences:
        if isinstance(sequence, ImageSequence):
            largest = max(largest, _largest(sequence))
    bits = next(bits for bits in USUAL_BITS if largest < 1 << bits)
    if not largest or bits == _DEEP:
        return sequences
    white = (1 << bits) - 1
    text = (
        f"pictures: the largest value in 16 bits is {largest}, so they are read as {bits}-bit pictures (white {white})"
    )
    notices = [Notice.info(NoticeCode.BIT_DEPTH, text)]
    scaled: list[Pictures] = []
    for sequence in sequences:
        if isinstance(sequence, ImageSequence):
            sequence = cast(Pictures, replace(sequence, white=white, notices=(*sequence.notices, *notices)))
            notices = []
        scaled.append(sequence)
    return tuple(scaled)


def _largest(images: ImageSequence) -> int:
    """The largest value in the 16-bit pictures, or the first one that needs all 16 bits; 0 without such pictures."""
    largest = 0
    for name in images.names:
        if png_bits(images.tree.head(name, _HEADER_BYTES)) == _DEEP:
            image = images.decode(name)
            largest = max(largest, int(image.max() if image.ndim == 2 else image[:, :, :3].max()))  # not alpha
            if largest >> USUAL_BITS[-2]:
                break
    return largest
