"""What becomes of a clip that was spoilt on purpose: whether it was harmed, and whether the report says so.

A cell is harmed when it scores more than MAX_LOSS_DB below the clean cell of the same series and seed, or its
depth errs by MAX_DEPTH_LOSS_MM more. Its score is the plain one; where no frame's light is the true one
(Condition.any_light) it is that after a fit of gain and offset. The clean cell has severity 0: the clean clip, or the
condition's own motion where that is calm. A harmed cell is `told` if its report has a kind of warning that the clean
cell's has not, else `silent`: that is the defect. The kind of a warning is its code. `refused` and `diverged` end in an
error that says why, `crashed` in one that nobody foresaw.
"""

from __future__ import annotations

import math

from intrasplat.errors import InputError, TrainingDiverged
from intrasplat.notices import Severity
from intrasplat.scene.scene import POSE_WARNINGS
from lab.conditions import CONDITIONS
from lab.evaluate.rows import Row

VERDICT = ("outcome", "loss_db", "depth_loss_mm", "fitted_loss_db")
PATH = ("path_error_mm", "path_error_deg")
MAX_LOSS_DB = 3.0
"""Twice the squared error: nobody would call that the same quality."""
MAX_PATH_ERROR_MM, MAX_PATH_ERROR_DEG = 1.5, 1.0
"""Error of an estimated camera path above which a cell is harmed and must have a warning in POSE_WARNINGS."""
MAX_DEPTH_LOSS_MM = 2.0
"""About the width of a grasper's jaw."""
SEPARATOR = " | "


def judged_by(condition: str) -> str:
    """The column with the loss that decides whether cells of a condition are harmed."""
    known = CONDITIONS.get(condition)
    return "fitted_loss_db" if known is not None and known.any_light else "loss_db"


def verdict(row: Row, clean: Row | None) -> dict[str, str]:
    """outcome, loss_db, depth_loss_mm and fitted_loss_db of a row, compared with its clean cell's.

    The outcome is unknown where the clean cell failed, or was measured before warnings had codes.
    """
    if row["error"]:
        return _without_figures(row["outcome"])
    if clean is None or clean["error"] or (clean["warnings"] and not clean.get("codes")):
        return _without_figures("unknown")
    loss_db, fitted_loss_db = (_less(clean[name], row[name]) for name in ("psnr_db", "fitted_db"))
    judged_db = fitted_loss_db if judged_by(row["condition"]) == "fitted_loss_db" else loss_db
    if math.isnan(judged_db):
        return _without_figures("unknown")
    depth_loss_mm = math.inf  # no depth where there was some
    if row["depth_error_mm"] and clean["depth_error_mm"]:
        depth_loss_mm = float(row["depth_error_mm"]) - float(clean["depth_error_mm"])
    new = new_warnings(row, clean)
    harmed = judged_db > MAX_LOSS_DB or depth_loss_mm > MAX_DEPTH_LOSS_MM
    outcome = "held" if not harmed else "told" if new else "silent"
    if _lost_its_way(row):
        doubts = {f"{Severity.WARNING}:{each}" for each in POSE_WARNINGS}
        outcome = "told" if doubts & {*row["codes"].split()} else "silent"
    return {
        "outcome": outcome,
        "loss_db": f"{loss_db:.2f}",
        "depth_loss_mm": f"{depth_loss_mm:.2f}",
        "fitted_loss_db": "" if math.isnan(fitted_loss_db) else f"{fitted_loss_db:.2f}",
        "new_warnings": SEPARATOR.join(new),
    }


def _without_figures(outcome: str) -> dict[str, str]:
    return dict.fromkeys(VERDICT, "") | {"outcome": outcome}


def _less(clean: str, spoilt: str) -> float:
    """How much less the second figure is; NaN where one is not known."""
    return float(clean) - float(spoilt) if clean and spoilt else math.nan


def _lost_its_way(row: Row) -> bool:
    """Whether an estimated camera path exceeds the maximum error."""
    limits = zip(PATH, (MAX_PATH_ERROR_MM, MAX_PATH_ERROR_DEG), strict=True)
    return any(float(row.get(name) or 0) > limit for name, limit in limits)


def failure(error: Exception) -> str:
    """The outcome of a cell that ended with this error."""
    if isinstance(error, InputError):
        return "refused"
    return "diverged" if isinstance(error, TrainingDiverged) else "crashed"


def new_warnings(row: Row, clean: Row) -> list[str]:
    """Texts of the row's warnings whose code the clean row has not; notices of severity info do not count."""
    known = set(clean["codes"].split())
    pairs = zip(row["codes"].split(), row["warnings"].split(SEPARATOR), strict=True) if row["codes"] else ()
    return [text for code, text in pairs if code not in known and code.partition(":")[0] == Severity.WARNING]
