"""The part of docs/results/index.md on light, on fields of view that are not the picture, and on stills."""

from __future__ import annotations

from pathlib import Path

from lab.evaluate.rows import read_rows
from lab.pages.markdown import origin, source, table

_FIELD = """
## A field of view that is not the whole picture

A recording cut to a disc with a soft rim and noise outside: score in the disc, and what the model claims outside.
"""
_LIGHT = """
## Smoke, exposure and white balance on stereo clips

`fast`, trained on clips with a drifting veil that takes 35 % of the light, with exposure to and fro over 1.5 stops, or
with a white balance of 1.3. Held-out frames of the left eye and the right, in dB: the model's steady light against the
clean frames, the same after one fit of gain and offset by channel, after a fit for each frame, and the recorded light
against the frames as given.
"""
_STILLS = """
## Stills

25 pairs of the phantom, 1.7 s apart: the endoscope advances by 100 mm and returns, the tissue breathes, rectification
leaves black borders. `hamlyn20`: 17 pairs of a recording, 3.3 s apart. Lost frames are left out and not scored.
"""
_FIELD_COLUMNS = {
    "clip": "clip", "cut": "cut", "fov": "fov", "psnr_in_disc_db": "in the disc, dB",
    "outside_confident": "outside >= 0.5", "outside_unseen": "outside hatched", "t_post_s": "seconds",
}  # fmt: skip
_LIGHT_COLUMNS = {
    "clip": "clip", "light": "light", "limit": "limit", "plain_db": "plain", "fitted_db": "fitted",
    "by_frame_db": "by frame", "recorded_db": "recorded", "right_plain_db": "right: plain", "right_fitted_db": "fitted",
    "right_by_frame_db": "by frame", "right_recorded_db": "recorded",
}  # fmt: skip
_STILLS_COLUMNS = {
    "clip": "clip", "ate_mm": "path error, mm", "ate_deg": "degrees", "lost": "lost frames",
    "psnr_tissue_db": "left, dB", "psnr_right_db": "right", "blend_db": "blending", "train_db": "trained frames",
    "outside_field": "Gaussians outside the field", "t_post_s": "seconds",
}  # fmt: skip


def recording_sections(folder: Path) -> list[str]:
    """The sections whose rows exist."""
    parts = []
    for text, file, columns in (
        (_LIGHT, "light.csv", _LIGHT_COLUMNS),
        (_FIELD, "field.csv", _FIELD_COLUMNS),
        (_STILLS, "stills.csv", _STILLS_COLUMNS),
    ):
        if rows := read_rows(folder / file):
            command = f"python -m lab.benchmarks.bm_{file.removesuffix('.csv')}"
            cells = [[row[name] for name in columns] for row in rows]
            parts += [text, source(command, file), table([*columns.values()], cells), origin(rows)]
    return parts
