"""How much glare can highlights=off take away?

    python -m lab.benchmarks.bm_glare [--widths 96 640] [--baselines 4.3 15]

highlights=off shows the darker of what the two eyes saw (docs/conventions.md). A row a clip of the phantom: the share
of the pixels that glare, and of their glare the share that both eyes see at the same place of the tissue, at true
depth. No training can take that away.
"""

from __future__ import annotations

import argparse

import numpy as np

from lab.phantom import Phantom, PhantomSettings, make_phantom

HEIGHT_PER_WIDTH = 0.8
ASIDE_MM = 4000.0
"""From this far beside the endoscope no mirrored light is seen."""
GLARES = 0.1
"""A pixel glares if the mirrored light adds at least this much to all three colours, which are in [0, 1]."""
MOMENTS = (0.0, 0.5)


def shared_glare(phantom: Phantom) -> tuple[float, float]:
    """The share of the left eye's pixels that glare, and of their glare the share that the right eye sees, too."""
    pixels = 0.0
    glare = shared = 0.0
    for moment in MOMENTS:
        frame = moment * phantom.settings.frames
        pose = phantom.world_from_camera(frame)
        beside_mm = pose[:3, 3] + pose[:3, 0] * ASIDE_MM
        right_mm = phantom.world_from_right(frame)[:3, 3]
        matt = phantom.render(frame, eye_mm=beside_mm)[0]
        left, right = ((phantom.render(frame, eye_mm=eye_mm)[0] - matt).min(-1) for eye_mm in (None, right_mm))
        glares = left > GLARES
        pixels += float(glares.mean()) / len(MOMENTS)
        glare += float(left[glares].sum())
        shared += float(np.minimum(left, right)[glares].clip(0).sum())
    return pixels, shared / glare


def main() -> None:
    """Print a row a clip."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--widths", type=int, nargs="+", default=[96, 640], metavar="PX")
    parser.add_argument("--baselines", type=float, nargs="+", default=[4.3, 15.0], metavar="MM")
    options = parser.parse_args()
    for width in options.widths:
        for baseline_mm in options.baselines:
            settings = PhantomSettings(width=width, height=round(width * HEIGHT_PER_WIDTH), baseline_mm=baseline_mm)
            pixels, shared = shared_glare(make_phantom(settings))
            print(f"{width} px, baseline {baseline_mm:g} mm: {pixels:.1%} glare; {shared:.0%} of it both eyes see")


if __name__ == "__main__":
    main()
