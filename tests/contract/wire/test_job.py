"""Options, states and views of a job; settings; exit codes; the progress line."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from pydantic import ValidationError

from contract.runtime.exits import LAST_WORDS_VARIABLE, ExitCode, end_by, exit_code_of, take_last_words
from contract.runtime.progress_bar import ProgressBar, format_progress
from contract.runtime.settings import Settings
from contract.store.shelf import new_job_id
from contract.wire.errors import Cancelled, InputError, LimitError, SceneError, UnavailableError
from contract.wire.job import (
    TERMINAL_STATES,
    TRANSITIONS,
    JobFiles,
    JobProgress,
    JobRecord,
    JobState,
    JobView,
    sources_of,
)
from contract.wire.names import LABORATORY_PRESETS
from contract.wire.options import JobOptions, parse_options

PROGRESS = JobProgress(stage="train", fraction=0.25, iteration=50, iterations=200, psnr_db=31.237, seconds_left=42.4)


def test_every_state_is_in_the_table_of_transitions_and_three_end_a_job() -> None:
    assert set(TRANSITIONS) == set(JobState)
    assert {state.value for state in TERMINAL_STATES} == {"done", "failed", "cancelled"}
    assert sources_of(JobState.DONE) == {JobState.RUNNING}
    assert sources_of(JobState.CANCELLED) == {JobState.QUEUED, JobState.RUNNING}


def test_options_left_out_are_fast_and_hold_out_every_eighth_frame() -> None:
    options = JobOptions.model_validate_json("{}")
    assert (options.preset, options.holdout, options.seed) == ("fast", "every8", 0)
    assert (options.budget_s, options.iterations) == (None, None)


def test_a_list_of_held_out_frames_is_kept_as_text() -> None:
    assert JobOptions.model_validate_json('{"holdout": [1, 9, 17]}').holdout == "1,9,17"


@pytest.mark.parametrize(
    "document",
    [
        '{"budget_s": 10, "iterations": 100}',
        '{"budget_s": 0}',
        '{"iterations": 0}',
        '{"holdout": "every9"}',
        '{"holdout": []}',
        '{"holdout": "' + "1," * 4000 + '1"}',
        '{"mask_polarity": "inside"}',
        '{"layout": "top"}',
        '{"presett": "fast"}',
        '{"preset": "slow"}',
        '{"seed": -1}',
        '{"min_depth_mm": 0}',
        '{"min_depth_mm": 300}',
        '{"min_depth_mm": 20, "max_depth_mm": 20}',
        '{"budget_s": NaN}',
    ],
)
def test_options_that_cannot_be_meant_are_refused(document: str) -> None:
    with pytest.raises(ValidationError):
        JobOptions.model_validate_json(document)


def test_the_view_of_a_finished_job_links_to_its_scene_and_shows_no_worker() -> None:
    record = JobRecord(job_id=new_job_id(), files=JobFiles(clip="clip.mp4"), created_at_s=1.0, owner="worker-7")
    queued = JobView.of(record)
    done = JobView.of(record.model_copy(update={"state": JobState.DONE, "progress": PROGRESS}))
    assert list(queued.links) == ["self", "events"]
    assert done.links["scene"] == f"/scenes/{record.job_id}"
    assert (done.stage, done.psnr_db) == ("train", 31.237)
    assert "worker-7" not in done.model_dump_json()


def test_settings_survive_the_way_through_the_environment() -> None:
    settings = Settings(data_dir=Path("/somewhere"), redis_url="redis://host:1", port=9000, worker_name="worker-2")
    assert Settings.from_environment(settings.to_environment()) == settings


def test_a_setting_that_is_not_accepted_names_its_variable() -> None:
    with pytest.raises(InputError, match="INTRASPLAT_PORT"):
        Settings.from_environment({"INTRASPLAT_PORT": "eighty"})


def test_exit_codes_tell_bad_input_from_failure_and_from_absence() -> None:
    assert exit_code_of(LimitError("clip", "too long.", "Cut it.")) is ExitCode.BAD_INPUT
    assert exit_code_of(UnavailableError("no queue.", "start it")) is ExitCode.UNAVAILABLE
    assert exit_code_of(Cancelled()) is ExitCode.INTERRUPTED
    assert exit_code_of(SceneError("gone")) is ExitCode.FAILED


def test_what_a_process_lacks_is_left_once_for_whoever_started_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = tmp_path / "words"
    assert end_by(UnavailableError("No queue.", "Start it.")) is ExitCode.UNAVAILABLE  # nobody asked for it
    monkeypatch.setenv(LAST_WORDS_VARIABLE, str(words))
    assert end_by(InputError("clip", "too long.", "Cut it.")) is ExitCode.BAD_INPUT
    assert take_last_words(words) is None
    assert end_by(UnavailableError("No room.", "Make some.")) is ExitCode.UNAVAILABLE
    left = take_last_words(words)
    assert left is not None
    assert (left.problem, left.remedy) == ("No room.", "Make some.")
    assert take_last_words(words) is None
    monkeypatch.setenv(LAST_WORDS_VARIABLE, str(tmp_path / "no folder" / "words"))
    assert end_by(UnavailableError("No disk.", "Mount it.")) is ExitCode.UNAVAILABLE
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "intrasplat: No queue. Start it."
    assert len(said) == 4


@pytest.mark.parametrize("damage", ["", "half a li", "[]", '{"problem": "No room."}'])
def test_last_words_that_cannot_be_read_are_none(damage: str, tmp_path: Path) -> None:
    (tmp_path / "words").write_text(damage)
    assert take_last_words(tmp_path / "words") is None


def test_the_progress_line_shows_stage_share_decibels_and_seconds_left() -> None:
    assert format_progress(PROGRESS) == "train      [######..................]  25%  31.24 dB  42 s left"
    assert "dB" not in format_progress(JobProgress(stage="stereo", fraction=1.0))


def test_a_log_file_gets_one_line_a_stage() -> None:
    log = io.StringIO()
    with ProgressBar(log) as bar:
        for stage in ("stereo", "stereo", "train", "train"):
            bar.show(JobProgress(stage=stage, fraction=0.5))
    assert log.getvalue() == "stereo\ntrain\n"


@pytest.mark.parametrize("preset", LABORATORY_PRESETS)
def test_a_variant_of_paper_is_not_offered_but_a_job_that_asked_for_one_is_still_read(preset: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_options(JobOptions, {"preset": preset})
    assert refused.value.field == "options.preset"
    record = JobRecord(job_id="0" * 32, files=JobFiles(clip="clip.mp4"), created_at_s=1.0)
    stored = json.loads(record.model_dump_json())
    stored["options"] |= {"preset": preset, "seed": 7}
    read = JobRecord.model_validate_json(json.dumps(stored))
    assert (read.options.preset, read.options.seed) == ("paper", 7)
