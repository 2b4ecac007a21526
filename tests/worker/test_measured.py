"""A worker measures in the scenes of its store."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.store.shelf import new_job_id
from contract.store.store import Store
from contract.wire.rendering import MeasureRequest
from intrasplat.errors import InputError, SceneError
from intrasplat.measuring import Measurement
from tests.worker.test_views import CLIP, UNITS_PER_MM, publish
from worker.views import Views


def test_points_of_a_stored_scene_are_measured_at_their_depth(tmp_path: Path) -> None:
    store, scene_id = Store(tmp_path), new_job_id()
    publish(store, scene_id)
    middle = (CLIP.width / 2, CLIP.height / 2)
    asked = MeasureRequest(scene_id=scene_id, attempt=1, t=0.25, points=(middle, (middle[0] + 10, middle[1])))
    views = Views(store)
    reply = views.answer(asked)
    assert (reply.media_type, reply.t, reply.is_untimed) == ("application/json", 0.25, True)
    found = Measurement.model_validate_json(reply.body)
    assert [each.depth_mm for each in found.points] == pytest.approx([60 / UNITS_PER_MM] * 2, rel=0.05)
    assert found.distance is not None
    assert found.distance.distance_mm == pytest.approx(10 * 60 / UNITS_PER_MM / CLIP.fx, rel=0.1)
    assert found.depth_range_mm[0] <= 60 / UNITS_PER_MM <= found.depth_range_mm[1]
    assert views.cost(asked) > 0
    with pytest.raises(InputError, match="outside the picture"):
        views.answer(asked.model_copy(update={"points": ((-1.0, 0.0),)}))
    with pytest.raises(SceneError):
        views.answer(asked.model_copy(update={"scene_id": new_job_id()}))
