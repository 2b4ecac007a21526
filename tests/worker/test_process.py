"""What a job asks for reaches the reconstruction whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.job import JobFiles, JobOptions, JobRecord
from contract.store import new_job_id
from worker.pipeline import ReconstructionRequest
from worker.process import request_of

SPOOL = Path("spool")
CHOSEN = {
    "preset": "paper",
    "budget_s": 12.5,
    "mask_polarity": "tissue",
    "layout": "sbs",
    "pose_convention": "llff",
    "holdout": "1,9",
    "seed": 4,
}


def request(files: JobFiles, options: dict[str, object]) -> ReconstructionRequest:
    record = JobRecord(job_id=new_job_id(), files=files, options=JobOptions.model_validate(options), created_at_s=0.0)
    return request_of(record, SPOOL, "cpu")


@pytest.mark.parametrize("chosen", [CHOSEN, {"iterations": 7}])
def test_every_option_of_a_job_is_one_of_the_request(chosen: dict[str, object]) -> None:
    asked = request(JobFiles(clip="clip.mp4"), chosen)
    for name, value in JobOptions.model_validate(chosen):
        assert getattr(asked, name) == value, name
    assert asked.device == "cpu"


def test_files_lie_where_the_store_keeps_them() -> None:
    all_files = JobFiles(clip="clip.mp4", right="right.mp4", calibration="calibration.json", masks="masks.zip")
    asked = request(all_files, {})
    assert (asked.clip, asked.right) == (SPOOL / "clip.mp4", SPOOL / "right.mp4")
    assert (asked.calibration, asked.masks) == (SPOOL / "calibration.json", SPOOL / "masks.zip")
    alone = request(JobFiles(clip="clip.zip"), {})
    assert (alone.right, alone.calibration, alone.masks) == (None, None, None)
