"""The motion models: their equations written out, their laws, their gradients, their round trip through tensors."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.helpers import assert_close
from worker.evaluate.variants.hexplane import HexPlane
from worker.evaluate.variants.polynomial import PolynomialFourier
from worker.evaluate.variants.quartic import QuarticFdm
from worker.model.deformation import Deformation, FlexibleDeformation, GaussianFdm, SharedBasis, restore
from worker.model.gaussians import Gaussians
from worker.model.layout import CHANNELS

COUNT = 6
TIMES = [0.0, 0.13, 0.5, 0.97]
FORMS: list[type[FlexibleDeformation]] = [GaussianFdm, QuarticFdm]


def canonical() -> Gaussians:
    random = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    return Gaussians(normal(COUNT, 3), normal(COUNT, 4), normal(COUNT, 3), normal(COUNT), normal(COUNT, 4, 3))


def stir(tensor: Tensor, amount: float, seed: int) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return tensor.double() + amount * torch.randn(tensor.shape, generator=random, dtype=torch.float64)


def moving(kind: str) -> Deformation:
    """A model of each kind whose every parameter is away from its start, float64."""
    start: dict[str, Deformation] = {
        "fdm-gaussian": GaussianFdm.initial(COUNT, bases=5, width=0.1),
        "fdm-quartic": QuarticFdm.initial(COUNT, bases=5, width=0.1),
        "shared": SharedBasis.initial(COUNT, bases=5),
        "shared with colour": SharedBasis.initial(COUNT, bases=5, colour=True),
        "shared with gloss": SharedBasis.initial(COUNT, bases=5, gloss=True),
        "pfs": PolynomialFourier.initial(COUNT, weights=8),
        "hexplane": HexPlane.initial(
            torch.tensor([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]]), space_cells=(4, 7), time_cells=5, features=3
        ),
    }
    model = start[kind]
    tensors = {name: stir(each, 0.02, seed) for seed, (name, each) in enumerate(model.parameters().items())}
    return restore(model.kind, tensors | {name: each.double() for name, each in model.constants().items()})


KINDS = ["fdm-gaussian", "fdm-quartic", "shared", "shared with colour", "shared with gloss", "pfs", "hexplane"]
STARTS: list[Deformation] = [
    GaussianFdm.initial(COUNT),
    QuarticFdm.initial(COUNT),
    SharedBasis.initial(COUNT),
    SharedBasis.initial(COUNT, colour=True),
    SharedBasis.initial(COUNT, gloss=True),
    PolynomialFourier.initial(COUNT),
    HexPlane.initial(torch.tensor([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]])),
]


def deformed_channels(model: Deformation, gaussians: Gaussians, t: float) -> Tensor:
    """[N, 10] what the model adds."""
    moved = model.deform(gaussians, t)
    return torch.cat(
        [
            moved.mean - gaussians.mean,
            moved.quaternion - gaussians.quaternion,
            moved.log_scale - gaussians.log_scale,
        ],
        dim=1,
    )


@pytest.mark.parametrize("model", STARTS, ids=KINDS)
@pytest.mark.parametrize("t", TIMES)
def test_every_model_starts_without_motion(model: Deformation, t: float) -> None:
    gaussians = Gaussians(**{name: each.float() for name, each in canonical().tensors().items()})
    moved = model.deform(gaussians, t)
    for name, each in moved.tensors().items():
        assert bool((each == gaussians.tensors()[name]).all()), name


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("t", TIMES)
def test_fdm_is_the_sum_its_equation_says(form: type[FlexibleDeformation], t: float) -> None:
    model = moving(form.kind)
    assert isinstance(model, FlexibleDeformation)
    expected = np.zeros((COUNT, CHANNELS))
    for n, c, j in np.ndindex(COUNT, CHANNELS, 5):
        w, theta, sigma = (float(each[n, c, j]) for each in (model.weight, model.centre, model.width))
        if form is GaussianFdm:
            expected[n, c] += w * math.exp(-((t - theta) ** 2) / (2 * sigma**2))
        else:
            expected[n, c] += w * math.exp(-(((t - theta) ** 2 / (sigma**2 + 1e-4)) ** 2))
    assert_close(deformed_channels(model, canonical(), t), expected, relative=1e-12)


def test_fdm_holds_a_width_at_its_floor() -> None:
    t = 0.501
    narrow = GaussianFdm(
        weight=torch.ones(1, CHANNELS, 1), centre=torch.full((1, CHANNELS, 1), 0.5), width=torch.zeros(1, CHANNELS, 1)
    )
    assert_close(narrow.basis(t), np.full((1, CHANNELS, 1), math.exp(-0.5)), relative=1e-4)
    width = narrow.width.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(dataclasses.replace(narrow, width=width).basis(t).sum(), [width])
    assert bool(gradient.isfinite().all())
    assert not gradient.any()


@pytest.mark.parametrize("form", FORMS)
def test_the_sign_of_a_width_changes_nothing(form: type[FlexibleDeformation]) -> None:
    model = moving(form.kind)
    assert isinstance(model, FlexibleDeformation)
    mirrored = dataclasses.replace(model, width=-model.width)
    assert bool((mirrored.basis(0.3) == model.basis(0.3)).all())


def test_fdm_starts_as_the_paper_says() -> None:
    model = GaussianFdm.initial(2)
    assert model.weight.shape == (2, CHANNELS, 17)
    assert_close(model.centre[1, 4], np.linspace(0, 1, 17))
    assert_close(model.width, np.full((2, CHANNELS, 17), 0.01))
    assert sum(each.numel() for each in model.parameters().values()) == 2 * 510


@pytest.mark.parametrize("form", FORMS)
def test_beyond_six_widths_of_every_centre_is_the_canonical_state(form: type[FlexibleDeformation]) -> None:
    random = torch.Generator().manual_seed(3)
    shape = (COUNT, CHANNELS, 4)
    centre = 0.3 * torch.rand(shape, generator=random, dtype=torch.float64)
    width = 0.01 + 0.09 * torch.rand(shape, generator=random, dtype=torch.float64)
    weight = torch.randn(shape, generator=random, dtype=torch.float64)
    model = form(weight, centre, width)
    t = float((centre + 6 * torch.sqrt(width**2 + (1e-4 if form is QuarticFdm else 0))).max())
    bound = float(weight.abs().sum(-1).max()) * math.exp(-18)  # exp(-6^2 / 2); the quartic form's exp(-6^4) is below
    assert_close(deformed_channels(model, canonical(), t), np.zeros((COUNT, CHANNELS)), absolute=bound)


TIMES_OUTSIDE_TOO = [-0.5, *TIMES, 1.0, 3.0]


@pytest.mark.parametrize("t", TIMES)
def test_shared_is_the_quotient_its_equation_says(t: float) -> None:
    model = moving("shared")
    assert isinstance(model, SharedBasis)
    bumps = [
        math.exp(-((t - float(theta)) ** 2) / (2 * float(sigma) ** 2))
        for theta, sigma in zip(model.centre, model.width, strict=True)
    ]
    phi = np.array(bumps) / sum(bumps)
    assert_close(deformed_channels(model, canonical(), t), model.weight.numpy() @ phi, relative=1e-12)


@pytest.mark.parametrize("bases", [1, 2, 5, 17, 33])
@pytest.mark.parametrize("t", TIMES_OUTSIDE_TOO)
def test_shared_bases_are_a_partition_of_unity_at_any_time(bases: int, t: float) -> None:
    phi = SharedBasis.initial(1, bases=bases).basis(t)
    assert bool((phi >= 0).all())
    assert float(phi.sum()) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("t", TIMES_OUTSIDE_TOO)
def test_equal_shared_weights_are_one_constant_offset(t: float) -> None:
    model = SharedBasis.initial(COUNT, bases=7)
    still = SharedBasis(torch.full_like(model.weight, 0.3).double(), model.centre.double(), model.width.double())
    assert_close(deformed_channels(still, canonical(), t), np.full((COUNT, CHANNELS), 0.3), relative=1e-12)


def test_shared_motion_carries_across_a_stretch_without_frames_from_both_its_ends() -> None:
    times = [*np.linspace(0, 0.4, 21), *np.linspace(0.7, 1, 16)]
    model = SharedBasis.initial(1, bases=8, times=times)
    weight = torch.where(model.centre <= 0.55, 1.0, 2.0).expand(1, CHANNELS, -1)
    moving_on = dataclasses.replace(model, weight=weight)
    path = np.array([float((moving_on.weight @ moving_on.basis(t))[0, 0]) for t in np.linspace(0.4, 0.7, 61)])
    assert bool((np.diff(path) >= -1e-6).all())  # from the one end to the other without a way back to 0
    assert 1 <= path[0] < 1.5 < path[-1] <= 2


def test_shared_bases_lie_where_the_training_frames_do() -> None:
    times = [0.0, 0.1, 0.2, 0.3, 0.4, 0.9]
    model = SharedBasis.initial(1, bases=6, times=times)
    assert_close(model.centre, np.array(times))
    assert_close(model.width, 0.6 * np.array([0.1, 0.1, 0.1, 0.1, 0.5, 0.5]), relative=1e-5)
    repeated = SharedBasis.initial(1, bases=5, times=[0.2, 0.2, 0.2])
    assert bool((repeated.width > 0).all())
    assert float(repeated.basis(0.9).sum()) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("t", TIMES)
def test_shared_channels_ten_to_thirteen_move_the_constant_colour_alone(t: float) -> None:
    model = moving("shared with colour")
    assert isinstance(model, SharedBasis)
    assert model.weight.shape[1] == 13
    gaussians = canonical()
    moved = model.deform(gaussians, t)
    assert_close(moved.sh[:, 0] - gaussians.sh[:, 0], model.weight[:, 10:] @ model.basis(t), relative=1e-12)
    assert bool((moved.sh[:, 1:] == gaussians.sh[:, 1:]).all())
    assert moved.opacity_logit is gaussians.opacity_logit
    without = SharedBasis(model.weight[:, :CHANNELS], model.centre, model.width)
    assert_close(deformed_channels(model, gaussians, t), deformed_channels(without, gaussians, t), relative=1e-12)


def test_shared_without_bases_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1, not 0"):
        SharedBasis.initial(3, bases=0)


def test_pfs_spans_its_polynomials_and_harmonics() -> None:
    model = PolynomialFourier(torch.zeros(1, CHANNELS, 8, dtype=torch.float64))  # 2 harmonics, 4 powers
    times = np.linspace(0, 1, 50)
    span = np.column_stack([np.ones(50), np.stack([model.basis(t).numpy() for t in times])])
    wanted = [times, times**2, times**3, times**4]
    wanted += [wave(2 * np.pi * h * times) for h in (1, 2) for wave in (np.cos, np.sin)]
    for each in wanted:
        fit, *_ = np.linalg.lstsq(span, each, rcond=None)
        assert_close(span @ fit, each, absolute=1e-9)
    assert np.linalg.matrix_rank(span) == 9


@pytest.mark.parametrize("weights", [1, 2, 3, 4, 9, 17])
def test_pfs_has_as_many_functions_as_weights(weights: int) -> None:
    model = PolynomialFourier.initial(3, weights=weights)
    assert model.basis(0.4).shape == (weights,)
    assert {name: each.shape for name, each in model.parameters().items()} == {"weight": (3, 10, weights)}


def test_hexplane_reads_planes_bilinearly() -> None:
    model = HexPlane.initial(
        torch.tensor([[0.0, 0.0, 0.0], [3.0, 3.0, 1.0]]), space_cells=(4,), time_cells=3, features=1
    )
    ramp = torch.arange(16.0).reshape(1, 4, 4)  # value 4 y + x at the cell corners
    planes = dict(model.planes[0]) | {"xy": ramp}
    model = dataclasses.replace(model, planes=(planes,))
    read = model.features(torch.tensor([[1.25, 2.5, 0.3]]), 0.7)
    assert float(read[0, 0]) == pytest.approx(4 * 2.5 + 1.25, rel=1e-5)  # times 1 of the untouched zt plane
    outside = model.features(torch.tensor([[9.0, 9.0, 9.0]]), 0.7)
    assert float(outside[0, 0]) == pytest.approx(15.0)


def test_hexplane_starts_from_its_seed() -> None:
    bounds = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    first, again, other = (HexPlane.initial(bounds, seed=seed, space_cells=(4,)) for seed in (1, 1, 2))
    assert bool((first.planes[0]["xy"] == again.planes[0]["xy"]).all())
    assert not bool((first.planes[0]["xy"] == other.planes[0]["xy"]).all())


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_those_of_finite_differences(kind: str) -> None:
    model, gaussians = moving(kind), canonical()
    names = list(model.parameters())

    def channels(mean: Tensor, *parameters: Tensor) -> Tensor:
        moved = restore(model.kind, dict(zip(names, parameters, strict=True)) | model.constants())
        at = moved.deform(dataclasses.replace(gaussians, mean=mean), 0.37)
        return torch.cat([at.mean, at.quaternion, at.log_scale, at.sh[:, 0]], dim=1)

    leaves = [gaussians.mean, *model.parameters().values()]
    leaves = [each.clone().requires_grad_() for each in leaves]
    assert torch.autograd.gradcheck(channels, leaves, fast_mode=kind == "hexplane")


@pytest.mark.parametrize("kind", [kind for kind in KINDS if "with" not in kind])
def test_deform_leaves_its_inputs_opacity_and_colour_alone(kind: str) -> None:
    model, gaussians = moving(kind), canonical()
    before = {name: each.clone() for name, each in (gaussians.tensors() | model.parameters()).items()}
    moved = model.deform(gaussians, 0.41)
    assert bool(deformed_channels(model, gaussians, 0.41).any())
    assert moved.opacity_logit is gaussians.opacity_logit
    assert moved.sh is gaussians.sh
    after = gaussians.tensors() | model.parameters()
    assert all(bool((after[name] == before[name]).all()) for name in before)


@pytest.mark.parametrize("kind", KINDS)
def test_select_keeps_the_motion_of_the_rows_it_takes(kind: str) -> None:
    model, gaussians = moving(kind), canonical()
    rows = torch.tensor([4, 1, 1])
    taken = Gaussians(**{name: each[rows] for name, each in gaussians.tensors().items()})
    expected = deformed_channels(model, gaussians, 0.6)[rows]
    assert_close(deformed_channels(model.select(rows), taken, 0.6), expected, relative=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_comes_back_from_its_tensors(kind: str) -> None:
    model = moving(kind)
    again = restore(model.kind, model.parameters() | model.constants())
    assert again.kind == model.kind
    assert list(again.parameters()) == list(model.parameters())
    assert bool((deformed_channels(again, canonical(), 0.2) == deformed_channels(model, canonical(), 0.2)).all())


@pytest.mark.parametrize(
    ("kind", "own", "common"),
    [
        ("fdm-gaussian", 3 * 10 * 5, 0),
        ("fdm-quartic", 3 * 10 * 5, 0),
        ("shared", 10 * 5, 2 * 5),
        ("shared with colour", 13 * 5, 2 * 5),
        ("shared with gloss", 14 * 5, 2 * 5),
        ("pfs", 10 * 8, 0),
        ("hexplane", 0, 7112),
    ],
)
def test_a_model_holds_its_own_numbers_per_gaussian_and_those_in_common(kind: str, own: int, common: int) -> None:
    model = moving(kind)
    held = sum(each.numel() for each in (model.parameters() | model.constants()).values())
    assert held == COUNT * own + common


@pytest.mark.parametrize(
    ("kind", "tensors", "message"),
    [
        ("spline", {}, "'spline' is not one of fdm-gaussian"),
        ("shared", {"weight": torch.zeros(2, 10, 3)}, "do not make a shared"),
        ("pfs", {"weight": torch.zeros(2, 9, 3)}, r"\(2, 9, 3\)"),
        ("hexplane", {"plane.0.xy": torch.zeros(1, 2, 2)}, "do not make a hexplane"),
    ],
    ids=["unknown kind", "missing tensors", "wrong shape", "missing planes"],
)
def test_tensors_that_make_no_model_are_refused(kind: str, tensors: dict[str, Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        restore(kind, tensors)


def test_shapes_that_do_not_belong_together_are_refused() -> None:
    weight = torch.zeros(2, CHANNELS, 3)
    with pytest.raises(ValueError, match="share one shape"):
        GaussianFdm(weight, weight[:1], weight)
    with pytest.raises(ValueError, match="must be positive"):
        SharedBasis(weight, torch.zeros(3), torch.tensor([0.1, 0.0, 0.1]))
    with pytest.raises(ValueError, match="centre and width"):
        SharedBasis(weight, torch.zeros(2), torch.ones(2))
    with pytest.raises(ValueError, match="6 Gaussians need"):
        GaussianFdm.initial(2).deform(canonical(), 0.0)
