"""The example of the documentation runs, and fits what it is given."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "fit_a_picture.py"


def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> list[float]:
    """The PSNR of every line that it prints, in dB."""
    monkeypatch.setattr("sys.argv", [str(EXAMPLE), *arguments])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    return [float(each) for each in re.findall(r"PSNR ([\d.]+) dB", capsys.readouterr().out)]


def test_it_fits_the_landscape(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "fit.png"
    psnr_db = run(monkeypatch, capsys, "--gaussians", "800", "--steps", "30", "--out", str(out))
    assert len(psnr_db) == 2
    assert psnr_db[1] > psnr_db[0] + 5
    with Image.open(out) as image:
        pair = np.asarray(image, float)
    assert pair.shape == (192, 2 * 288 + 4, 3)
    difference = pair[:, :288] - pair[:, 292:]
    assert -10 * np.log10((difference**2).mean() / 255**2) == pytest.approx(psnr_db[1], abs=0.1)


def test_it_fits_a_picture_from_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    i, j = np.mgrid[:24, :40]
    picture, out = tmp_path / "grey.png", tmp_path / "fit.png"
    Image.fromarray((5 * i + 3 * j).astype(np.uint8)).save(picture)
    first, last = run(monkeypatch, capsys, str(picture), "--gaussians", "150", "--steps", "20", "--out", str(out))
    assert last > first + 2
    with Image.open(out) as pair:
        assert pair.size == (2 * 40 + 4, 24)
