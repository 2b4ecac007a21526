"""The finder of a clip's instruments, one frame at a time, and its entries in the report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.instruments.find import FoundMask, Image, Looked, Mask, Rgb, TissueLook, find_instruments
from intrasplat.instruments.segmenter import Segmenter
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import Masks

MIN_SURE = 0.7
"""The report warns if a smaller share of the possible instruments is clear."""
MAX_UNSURE = 0.012
"""The report warns if a larger share of the picture may be instruments and is unclear, whatever the rest."""
MAX_MISSED = 0.001
"""The report warns if a larger share of the picture may be instruments and is not masked. Clips whose instruments are
all found or that have none have 0.0005 at most, clips with a missed instrument 0.002 and more."""
LOOKED_AT = 7
"""Number of pictures from which the tissue's colour is measured."""


@dataclass(frozen=True)
class Finder:
    """Finds instruments in single pictures of one clip: by the segmenter if there is one, else by colour and depth.

    field  [H, W] field of view; None: the whole picture
    """

    look: TissueLook | None
    segmenter: Segmenter | None = None
    field: Mask | None = None

    @classmethod
    def of(cls, pictures: Iterable[Rgb], field: Mask | None = None, segmenter: Segmenter | None = None) -> Finder:
        """The finder of a clip, from some of its pictures [H, W, 3] and their field of view."""
        return cls(TissueLook.of(pictures, field) if segmenter is None else None, segmenter, field)

    def __call__(self, rgb: Rgb, nearness: Callable[[Rgb], Image]) -> FoundMask:
        """The instruments in a picture [H, W, 3]; nearness(coarse) returns the nearness of its coarse form."""
        if self.segmenter is not None:
            return self.segmenter(rgb)
        assert self.look is not None
        picture = Looked.at(rgb, self.field)
        return find_instruments(picture, nearness(picture.coarse), self.look)

    def report(self, share: float, found: NDArray[np.float64]) -> tuple[Masks, Notice, tuple[Notice, ...]]:
        """The report's entry on masks, the assumption, and warnings.

        Args:
            share: masked share of all pixels.
            found: [frames, 3] seen, clear and missed (FoundMask) of the searched frames.
        """
        seen, clear, missed = found.mean(axis=0)
        sure = float(clear / seen) if seen > 0 else 1.0
        how = "found by colour and depth" if self.segmenter is None else "found by this installation's segmenter"
        masks = Masks(source="found" if self.segmenter is None else "segmenter", share=share, sure=sure)
        text = f"masks: none given; instruments were {how} in {share:.1%} of the picture"
        warnings = []
        if sure < MIN_SURE or seen - clear > MAX_UNSURE:
            problem = (
                f"No masks were given, and only {sure:.0%} of what looks like instruments is clearly distinct from "
                "tissue: some may be modelled as tissue, or tissue left out. Give masks."
            )
            warnings.append(Notice.warning(NoticeCode.MASKS_UNSURE, problem))
        elif missed > MAX_MISSED:
            problem = (
                f"No masks were given, and {missed:.1%} of the picture may be instruments that were not found: they "
                "lie on the tissue or are wholly inside the picture. Whatever is not masked is modelled as tissue: if "
                "they are instruments, give masks."
            )
            warnings.append(Notice.warning(NoticeCode.MASKS_UNSURE, problem))
        return masks, Notice.info(NoticeCode.MASKS, text), tuple(warnings)


def looked_at(frames: Sequence[int]) -> Sequence[int]:
    """The frames, out of those given, from which the tissue's colour is measured."""
    return frames[:: -(-len(frames) // LOOKED_AT)]
