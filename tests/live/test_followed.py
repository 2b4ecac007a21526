"""`isp.follow` and `intrasplat live` show, print and keep a live source."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import intrasplat as isp
from intrasplat.__main__ import main
from intrasplat.commands.exits import ExitCode
from intrasplat.errors import InputError, UnavailableError
from tests.live.conftest import until
from tests.live.senders import PhantomSender, video_file


def test_a_followed_source_is_shown_and_cut(sender: PhantomSender, tmp_path: Path) -> None:
    calibration = sender.calibration.model_dump(exclude={"assumptions"})
    with isp.follow(sender.url, calibration, out=tmp_path, width=128, layout="sbs", device="cpu") as live:
        with pytest.raises(InputError, match="nothing is known yet"):
            live.view()
        assert live.wait(20.0), live.report()
        until(lambda: (past := live.report().past) and past.ends_s > 3.0, live.report)
        now, before = live.view(pose=isp.orbit(10, 0)), live.view("-1.0", width=64)
        assert now.rgb.shape == (96, 128, 3)
        assert before.rgb.shape == (48, 64, 3)
        assert np.median(now.confidence) > 0
        assert live.moment(-1.0).source_s == pytest.approx(live.moment().source_s - 1.0, abs=0.5)
        live.pause()
        cut = live.cut(0.5, 2.5, tmp_path / "cut.mp4")
        assert cut.frames > 30
        with pytest.raises(InputError, match="there is no folder"):
            live.cut(0.5, 2.5, tmp_path / "none" / "cut.mp4")
        with pytest.raises(InputError, match="before the past"):
            live.view(-1000.0)
    again = isp.follow(sender.url, calibration, out=tmp_path, width=128, layout="sbs", device="cpu")
    again.close()
    assert again.moment("-1.5").age_s > 1.5


def test_the_command_prints_reports_and_writes_a_cut(
    sender: PhantomSender, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = tmp_path / "calibration.json"
    calibration.write_text(sender.calibration.model_dump_json(exclude={"assumptions"}))
    asked = ["live", sender.url, "--calibration", str(calibration), "--out", str(tmp_path / "feed")]
    asked += ["--width", "128", "--seconds", "5", "--cut", "2", "--json", "--device", "cpu"]
    assert main(asked) == ExitCode.OK
    reports = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(reports) == 5
    assert reports[-1]["state"] in ("live", "behind")
    assert reports[-1]["model"]["width"] == 128
    assert (tmp_path / "feed" / "cut.mp4").stat().st_size > 1000
    assert any((tmp_path / "feed" / "segments").iterdir())


def test_what_cannot_be_read_has_its_exit_code(
    sender: PhantomSender, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration, text = tmp_path / "calibration.json", tmp_path / "text.mp4"
    grey = video_file(tmp_path / "grey.mkv", 120)
    text.write_text("this is no video\n" * 100)
    calibration.write_text(sender.calibration.model_dump_json(exclude={"assumptions"}))
    for source, code, why in (
        (str(text), ExitCode.BAD_INPUT, "neither an MPEG transport stream"),
        (str(grey), ExitCode.BAD_INPUT, "show no tissue"),
        ("tcp://127.0.0.1:9", ExitCode.UNAVAILABLE, "does not answer"),
    ):
        asked = ["live", source, "--calibration", str(calibration), "--seconds", "12", "--layout", "sbs"]
        assert main([*asked, "--device", "cpu"]) == code
        assert why in capsys.readouterr().err


def test_a_calibration_of_another_size_has_its_exit_code(
    sender: PhantomSender, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = tmp_path / "calibration.json"
    other = sender.calibration.model_copy(update={"width": 640, "height": 240})
    calibration.write_text(other.model_dump_json(exclude={"assumptions"}))
    asked = ["live", sender.url, "--calibration", str(calibration), "--layout", "sbs", "--seconds", "12"]
    assert main([*asked, "--device", "cpu"]) == ExitCode.BAD_INPUT
    assert "calibration: " in capsys.readouterr().err


def test_a_source_of_which_nothing_is_known_says_why(sender: PhantomSender, tmp_path: Path) -> None:
    calibration, text = sender.calibration.model_dump(exclude={"assumptions"}), tmp_path / "text.mp4"
    text.write_text("this is no video\n" * 100)
    with isp.follow(str(text), calibration, out=tmp_path / "out", device="cpu") as live:
        assert not live.wait(3600.0)
        with pytest.raises(InputError, match="neither an MPEG transport stream"):
            live.view()
        with pytest.raises(InputError, match="is no time"):
            live.moment(None)  # type: ignore[arg-type]
    with isp.follow("tcp://127.0.0.1:9", calibration, device="cpu") as live:
        until(lambda: live.report().reason, live.report)
        with pytest.raises(UnavailableError, match="does not answer"):
            live.view()


def test_a_source_or_a_calibration_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        isp.follow("tcp://127.0.0.1:9", tmp_path / "none.json")
    assert refused.value.field == "calibration"
    assert main(["live", "tcp://127.0.0.1", "--calibration", str(tmp_path)]) == ExitCode.BAD_INPUT
