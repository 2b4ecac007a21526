"""Options that cannot go with a clip's files are refused on arrival, with the option and a remedy named."""

from __future__ import annotations

import zipfile
from collections.abc import Collection
from pathlib import Path

import pytest

from intrasplat.errors import InputError
from intrasplat.intake.fit import check_fit
from intrasplat.options import JobOptions, parse_options

PAIR = ("left.mp4", "right.mp4", "calibration.json")


def files_in(folder: Path, *names: str) -> dict[str, Path]:
    """Empty files by part; `poses.zip` is a clip with poses, `clip.zip` one without."""
    paths = {}
    for name in names:
        path = folder / name.replace("poses.", "clip.")
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("clip/images/000000.png", b"")
            if name.startswith("poses."):
                archive.writestr("clip/poses_bounds.npy", b"")
        paths[path.stem] = path
    return paths


@pytest.mark.parametrize(
    ("options", "names", "sent", "field"),
    [
        ({"layout": "sbs"}, PAIR, PAIR, "options.layout"),
        ({"layout": "frames"}, ("clip.mp4",), ("clip",), "options.layout"),
        ({"layout": "stereomis"}, ("clip.webm",), ("clip",), "options.layout"),
        ({"layout": "endonerf"}, ("clip.mkv",), ("clip",), "options.layout"),
        ({"layout": "endonerf"}, ("clip.zip",), ("clip",), "clip"),
        ({"poses": "given"}, PAIR, PAIR, "options.poses"),
        ({"poses": "given"}, ("clip.mp4",), ("clip",), "options.poses"),
        ({"poses": "given"}, ("clip.zip",), ("clip",), "options.poses"),
        ({"poses": "given", "layout": "frames"}, ("poses.zip",), ("clip",), "options.poses"),
        ({"poses": "estimate"}, (*PAIR, "poses_file.tum"), ("poses_file",), "options.poses"),
        ({"mask_source": "none"}, ("clip.mp4", "masks.zip"), ("masks",), "options.mask_source"),
        ({"fov": "all"}, (*PAIR, "fov_mask.png"), (*PAIR, "fov_mask"), "fov_mask"),
        ({}, ("left.mp4", "right.mp4"), ("left", "right"), "calibration"),
        ({"layout": "sbs"}, ("clip.mp4",), ("clip",), "calibration"),
        ({"layout": "tb"}, ("clip.webm", "masks.zip"), ("clip", "masks"), "calibration"),
    ],
)
def test_what_cannot_go_together_names_the_field_and_a_remedy(
    tmp_path: Path, options: dict[str, object], names: Collection[str], sent: Collection[str], field: str
) -> None:
    with pytest.raises(InputError) as caught:
        check_fit(parse_options(JobOptions, options), files_in(tmp_path, *names), sent)
    assert (caught.value.field, bool(caught.value.remedy)) == (field, True)


@pytest.mark.parametrize(
    ("options", "names", "sent"),
    [
        ({}, PAIR, PAIR),
        ({"poses": "estimate"}, PAIR, PAIR),
        ({"layout": "tb", "poses": "fixed"}, ("clip.mp4", "calibration.json"), ("clip",)),
        ({"layout": "sbs"}, ("clip.zip",), ("clip",)),
        ({}, ("left.zip", "right.mp4"), ("left", "right")),
        ({}, ("clip.mp4",), ("clip",)),
        ({"layout": "frames"}, ("clip.zip",), ("clip",)),
        ({"poses": "given"}, ("poses.zip",), ("clip",)),
        ({"poses": "given", "layout": "endonerf"}, ("poses.zip",), ("clip",)),
        ({"poses": "given"}, (*PAIR, "poses_file.tum"), PAIR),
        ({"poses": "estimate"}, (*PAIR, "poses_file.tum"), PAIR),
        ({"mask_source": "none"}, ("clip.mp4", "masks.zip"), ()),
        ({}, (*PAIR, "fov_mask.png"), (*PAIR, "fov_mask")),
        ({"fov": "all"}, (*PAIR, "fov_mask.png"), PAIR),
        ({"mask_source": "auto"}, ("clip.mp4", "masks.zip"), ("masks",)),
    ],
)
def test_what_goes_together_passes(
    tmp_path: Path, options: dict[str, object], names: Collection[str], sent: Collection[str]
) -> None:
    check_fit(parse_options(JobOptions, options), files_in(tmp_path, *names), sent)
