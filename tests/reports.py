"""A whole report and notices for tests whose subject they are not."""

from __future__ import annotations

from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import Report

REPORT_OF_A_SCENE = Report(
    psnr_tissue_db=36.2,
    psnr_paper_db=37.0,
    ssim=0.95,
    baseline_blend_db=30.0,
    baseline_flow_db=None,
    depth_agreement_mm=0.5,
    coverage=0.99,
    train_psnr_tissue_db=37.5,
    warnings=(),
    assumptions=(),
    preset="fast",
    seed=0,
    device="cpu",
    iterations=30,
    seconds={"t_train_s": 1.0},
    gaussians=1000,
    bases=17,
    scene_bytes=10_000,
    units_per_mm=1.0,
    width=6,
    height=4,
    frame_count=12,
    train_count=10,
    held_out=(1, 9),
    repeated=(),
    frame_times_s=tuple(each / 12 for each in range(12)),
)


def a_warning(text: str, code: NoticeCode = NoticeCode.UNCLASSIFIED) -> Notice:
    """A warning whose code does not matter."""
    return Notice.warning(code, text)
