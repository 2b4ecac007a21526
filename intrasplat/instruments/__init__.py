"""A picture and its nearness (inverse depth) in; a mask of its instruments, and how sure it is, out.

Verbs: find_instruments, Finder.of, with_instruments_found, load_segmenter, zipped_masks.
"""

from intrasplat.instruments.depth_clip import with_instruments_found
from intrasplat.instruments.find import FoundMask, Looked, TissueLook, find_instruments, smooth_nearness
from intrasplat.instruments.finder import Finder, looked_at
from intrasplat.instruments.masks_file import zipped_masks
from intrasplat.instruments.segmenter import Segmenter, load_segmenter

__all__ = [
    "Finder",
    "FoundMask",
    "Looked",
    "Segmenter",
    "TissueLook",
    "find_instruments",
    "load_segmenter",
    "looked_at",
    "smooth_nearness",
    "with_instruments_found",
    "zipped_masks",
]
