"""Stereo clip (files or frames) in; depth in mm and its confidence for every frame out.

Verbs: open_with_depth, match_eyes, estimate_depth.
"""

from intrasplat.stereo.depth import estimate_depth
from intrasplat.stereo.opening import ClipPaths, match_eyes, open_with_depth

__all__ = ["ClipPaths", "estimate_depth", "match_eyes", "open_with_depth"]
