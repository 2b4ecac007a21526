"""Figures that papers print, for comparison by eye: other hardware, other data, and psnr_paper, not psnr_tissue.

All from Yang et al., "Deform3DGS", MICCAI 2024 (arXiv 2405.17835), tables 1 and 3; one NVIDIA RTX A5000. The clips are
those of the EndoNeRF and StereoMIS data sets, which are not part of this project.
"""

from __future__ import annotations

from dataclasses import dataclass

LABEL = "published, other hardware and data (psnr_paper)"


@dataclass(frozen=True)
class Published:
    """One row of a table in a paper; fps is images rendered a second, None where the table has none."""

    method: str
    data: str
    psnr_paper_db: float
    train_s: float
    fps: float | None


RESULTS = (
    Published("EndoNeRF", "EndoNeRF", 35.55, 21600, 0.03),
    Published("LerPlane", "EndoNeRF", 36.56, 600, 1.45),
    Published("EndoGaussian", "EndoNeRF", 37.66, 138, 128.13),
    Published("Deform3DGS", "EndoNeRF", 37.90, 64, 338.80),
    Published("EndoNeRF", "StereoMIS", 28.86, 21600, 0.03),
    Published("LerPlane", "StereoMIS", 29.46, 600, 1.52),
    Published("EndoGaussian", "StereoMIS", 30.25, 151, 134.50),
    Published("Deform3DGS", "StereoMIS", 30.48, 66, 330.37),
)
"""Table 1."""
ABLATION = {"paper": 37.90, "without_mapf": 37.47, "hexplane": 37.13, "pfs": 37.08}
"""Table 3, psnr_paper in dB by our names of the series; "paper" is FDM with MAPF."""
