"""The doctor sees what is there, and says in one line how to mend what is not."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from intrasplat.commands.doctor import (
    OPTIONAL_PACKAGES,
    PACKAGES,
    Diagnosis,
    device_finding,
    examine,
    format_findings,
    video_finding,
)
from intrasplat.machine.gpu import Gpu
from tests.test_repository import project, requirement_name

H200 = Gpu(build="13.0", name="NVIDIA H200", triton="3.9.0")


def found(device: str = "auto", segmenter: Path | None = None) -> dict[str, Diagnosis]:
    return {finding.topic: finding for finding in examine(device, segmenter)}


def test_this_installation_is_complete_and_its_decoder_is_not_the_vulnerable_one() -> None:
    findings = found()
    assert set(PACKAGES) <= set(findings)
    assert [finding for finding in findings.values() if finding.blocks] == []
    assert findings["video decoder"].remedy is None


def test_every_package_that_is_required_is_looked_for() -> None:
    extras = project()["optional-dependencies"]
    assert {requirement_name(each) for each in project()["dependencies"]} == set(PACKAGES)
    optional = {requirement_name(each) for name in ("charts", "gpu", "mesh", "onnx") for each in extras[name]}
    assert optional == set(OPTIONAL_PACKAGES)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_cannot_be_trained_on_blocks_and_has_a_remedy() -> None:
    assert found()["device"].found.startswith("cpu, ")
    finding = found("cuda")["device"]
    assert finding.blocks
    assert finding.remedy is not None
    assert finding.remedy.endswith("INTRASPLAT_DEVICE=cpu.")


def test_the_gpu_that_would_be_trained_on_is_named() -> None:
    assert device_finding("auto", H200) == Diagnosis("device", "cuda (NVIDIA H200)")
    assert device_finding("cpu", H200).found.endswith("(the GPU is not asked for)")


def test_a_gpu_that_lies_idle_for_want_of_something_has_a_remedy() -> None:
    finding = device_finding("auto", dataclasses.replace(H200, triton=None))
    assert "NVIDIA H200 is not used: Triton is not installed" in finding.found
    assert finding.remedy is not None
    assert "pip install '.[gpu]'" in finding.remedy
    assert not finding.blocks


def test_a_gpu_whose_triton_is_too_old_lies_idle_with_both_versions_named() -> None:
    finding = device_finding("auto", dataclasses.replace(H200, triton="3.5.1"))
    assert "NVIDIA H200 is not used: Triton is 3.5.1, where 3.6 to 3.9 are supported" in finding.found
    assert device_finding("cuda", dataclasses.replace(H200, triton="3.5.1")).blocks


@pytest.mark.parametrize(
    ("release", "found", "remedy"),
    [
        ("8.1.2", "FFmpeg 8.1.2", None),
        ("n8.2", "FFmpeg 8.2", None),
        ("8.1.1", "FFmpeg 8.1.1", "CVE-2026-8461"),
        ("N-12345-gabcdef", "FFmpeg N-12345-gabcdef", "8.1.2 or newer"),
    ],
)
def test_an_ffmpeg_with_a_known_hole_has_a_remedy(release: str, found: str, remedy: str | None) -> None:
    finding = video_finding(release)
    assert finding.found == found
    assert (finding.remedy is None) if remedy is None else (remedy in str(finding.remedy))


@pytest.mark.parametrize(
    ("finding", "mark"),
    [
        (Diagnosis("a", "fine"), "ok"),
        (Diagnosis("a", "old", "update it"), "look"),
        (Diagnosis("a", "gone", "install it", blocks=True), "missing"),
    ],
)
def test_each_line_begins_with_how_it_stands_and_the_remedy_follows(finding: Diagnosis, mark: str) -> None:
    lines = format_findings([finding]).splitlines()
    assert lines[0].split()[0] == mark
    assert len(lines) == (1 if finding.remedy is None else 2)


def test_a_segmenter_that_cannot_be_used_blocks_and_has_a_remedy(tmp_path: Path) -> None:
    assert "segmenter" not in found()
    finding = found(segmenter=tmp_path / "missing.onnx")["segmenter"]
    assert finding.blocks
    assert finding.remedy is not None
