"""The running mean is the mean, of copies, and goes on after a stop as if there had been none."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from intrasplat.methods.registry import PRESETS
from intrasplat.train import average
from intrasplat.train.average import PREFIX, RunningMean
from tests.intrasplat.phantoms import phantom_clip, prepared

Parameters = dict[str, Tensor]


@pytest.fixture
def models(rng: np.random.Generator) -> list[Parameters]:
    shapes = {"mean": (3, 16), "motion.weight": (10, 4, 16), "opacity": (16,)}
    return [
        {name: torch.from_numpy(rng.normal(size=shape)).float() for name, shape in shapes.items()} for _ in range(6)
    ]


def mean_of(mean: RunningMean, like: Parameters) -> Parameters:
    found = {name: torch.full_like(values, torch.nan) for name, values in like.items()}
    mean.put(found)
    return found


def test_what_is_put_is_the_mean_of_what_was_added(models: list[Parameters]) -> None:
    mean = RunningMean()
    for model in models:
        mean.add(model)
    assert mean.count == len(models)
    for name, values in mean_of(mean, models[0]).items():
        expected = np.mean([model[name].double().numpy() for model in models], axis=0)
        assert values.dtype == torch.float32
        np.testing.assert_allclose(values, expected, atol=1e-6)


def test_a_mean_in_files_has_the_same_bits(models: list[Parameters], monkeypatch: pytest.MonkeyPatch) -> None:
    means, stored = [], []
    for large in (average.LARGE_BYTES, 0):
        monkeypatch.setattr(average, "LARGE_BYTES", large)
        first, mean = RunningMean(), RunningMean()
        for model in models[:3]:
            first.add(model)
        stored.append({name: values.clone() for name, values in first.arrays().items()})
        first.let_go()
        mean.load_arrays(first.arrays(), first.count)
        for model in models[3:]:
            mean.add(model)
        means.append(mean_of(mean, models[0]))
    for made in (means, stored):
        for name, values in made[0].items():
            np.testing.assert_array_equal(values, made[1][name])


def test_the_mean_of_one_model_is_that_model(models: list[Parameters]) -> None:
    mean = RunningMean()
    mean.add(models[0])
    for name, values in mean_of(mean, models[0]).items():
        np.testing.assert_array_equal(values, models[0][name])


def test_a_mean_that_was_put_is_over(models: list[Parameters]) -> None:
    mean = RunningMean()
    mean.add(models[0])
    mean_of(mean, models[0])
    assert (mean.count, mean.arrays()) == (0, {})
    mean.add(models[1])
    for name, values in mean_of(mean, models[0]).items():
        np.testing.assert_array_equal(values, models[1][name])


def test_adding_copies_and_leaves_what_it_is_given(models: list[Parameters]) -> None:
    """A model's arrays are live: training goes on in them."""
    mean, live = RunningMean(), {name: values.clone() for name, values in models[0].items()}
    mean.add(live)
    for name, values in live.items():
        values[...] = models[1][name]
    mean.add(live)
    for name, values in live.items():
        np.testing.assert_array_equal(values, models[1][name])
    for name, values in mean_of(mean, live).items():
        np.testing.assert_array_equal(values, (models[0][name] + models[1][name]) / 2)


@pytest.mark.parametrize("stopped_after", range(7))
def test_a_stored_mean_goes_on_to_the_same_bits(models: list[Parameters], stopped_after: int) -> None:
    straight, before, resumed = RunningMean(), RunningMean(), RunningMean()
    for model in models:
        straight.add(model)
    for model in models[:stopped_after]:
        before.add(model)
    stored = {name: values.clone() for name, values in before.arrays().items()}
    resumed.load_arrays({"mean": torch.zeros(3), **stored}, before.count)
    for model in models[stopped_after:]:
        resumed.add(model)
    expected = mean_of(straight, models[0])
    for name, values in mean_of(resumed, models[0]).items():
        np.testing.assert_array_equal(values, expected[name])


def test_loaded_sums_are_copies(models: list[Parameters]) -> None:
    mean, resumed = RunningMean(), RunningMean()
    mean.add(models[0])
    stored = mean.arrays()
    resumed.load_arrays(stored, mean.count)
    resumed.add(models[1])
    for name, values in models[0].items():
        np.testing.assert_array_equal(stored[PREFIX + name], values)


@pytest.mark.parametrize("name", PRESETS)
def test_a_models_parameters_are_live_and_part_of_what_is_stored(name: str) -> None:
    model = prepared(phantom_clip(), name)[0].model
    parameters, stored = model.parameters(), model.arrays()
    assert parameters.keys() < stored.keys()
    assert not any(each.startswith(PREFIX) for each in stored)
    for each, values in parameters.items():
        values[...] = 0.25
        assert (stored[each] == 0.25).all()
        assert "moments" not in each
