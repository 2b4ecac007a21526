"""Part of gpu_check.py: tiles of other shapes, chunks and warps: how wrong they are, and what a step takes with them.

The worst error is that of gpu_correct.py's comparison with the reference in float64; a step is that of gpu_speed.py,
replayed as a graph. gpu_estimate.py says which shape machine code and counted work let expect most of.
"""

from __future__ import annotations

import traceback
from typing import Any

from bm_raster import RATES
from gpu_compile import shaped
from gpu_correct import LIMIT, REAL, SMALL, Checks
from gpu_estimate import SHAPES
from gpu_rows import Part, device_ms
from gpu_speed import CAMERAS, Speed

from worker.model.loss import LossSettings
from worker.raster.cuda.blend import blend

FIELDS = ("tile", "chunk", "warps", "worst", "ok", "step_ms", "instances", "registers", "spilled_bytes", "note")
LEAST_S = 12.0
"""Seconds that have to be left to begin a shape: its kernels are compiled first."""


def main() -> None:
    part = Part.begin("variants", FIELDS)
    checks, speed = Checks(part, SMALL if part.interpret else REAL), Speed(part)
    for shape in SHAPES[:1] if part.interpret else SHAPES:
        width, height, chunk, warps = shape
        if not part.has(0 if part.interpret else LEAST_S, f"tiles of {width}x{height}, {warps} warps"):
            continue
        row: dict[str, Any] = {"tile": f"{width}x{height}", "chunk": chunk, "warps": warps}
        known = _compiled(part.interpret)
        try:
            with shaped(*shape):
                row |= measured(part, checks, speed)
        except Exception as error:
            traceback.print_exc()
            row |= {"ok": False, "note": f"{type(error).__name__}: {error}"[:200]}
        new = [each for key, each in _compiled(part.interpret).items() if key not in known]
        if new:
            row |= {"registers": max(each.n_regs for each in new), "spilled_bytes": max(each.n_spills for each in new)}
        print("  " + "  ".join(f"{name} {value}" for name, value in row.items()), flush=True)
        part.add(**row)


def measured(part: Part, checks: Checks, speed: Speed) -> dict[str, Any]:
    """Error and step of rasterisers as they are made just now."""
    found = checks.autograd(2.0, (0.05, 0.4, 0.999))
    worst = max(found.values())
    model = speed.model("shared")
    frame = speed.frame(0.4)
    for iteration in range(1, 2 if part.interpret else CAMERAS):
        model.step([frame], LossSettings(), RATES, iteration)
    model.wait()
    calls, rounds = (1, 1) if part.interpret else (32, 11)
    launches = model._training.launches
    step_ms = device_ms(
        lambda: launches.run(("step", 0), lambda: model._launch(0)), part.device, calls=calls, rounds=rounds
    )
    instances = int(model._training.rasterizer.needed)
    return {"worst": worst, "ok": bool(worst <= LIMIT), "step_ms": step_ms, "instances": instances}


def _compiled(interpret: bool) -> dict[Any, Any]:
    """Forms of blend that this process has loaded; one that asks for too much is compiled and cannot be."""
    if interpret:
        return {}
    return {key: each for key, each in blend.device_caches[0][0].items() if each.module is not None}


if __name__ == "__main__":
    main()
