"""The canonical Gaussians: spherical harmonics against their closed form, activations, and the start from points."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from torch import Tensor

from intrasplat.errors import InputError
from intrasplat.splat.constants import SH_C0
from intrasplat.splat.gaussians import (
    MAX_START_SCALE,
    MIN_START_SCALE,
    Gaussians,
    initial_gaussians,
    sh_basis,
    sh_colour,
    sh_from_rgb,
)
from tests.helpers import assert_close


def directions(count: int, seed: int = 0) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=random, dtype=torch.float64), dim=-1)


def test_sh_basis_is_the_real_form_of_the_complex_harmonics() -> None:
    direction = directions(200)
    x, y, z = direction.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            complex_harmonic = sph_harm_y(degree, abs(order), polar, azimuth)  # Condon-Shortley phase included
            part = complex_harmonic.imag if order < 0 else complex_harmonic.real
            columns.append(part * (math.sqrt(2) if order else 1))
    assert_close(sh_basis(3, direction), np.stack(columns, axis=1), relative=1e-12)


def test_sh_basis_is_orthonormal_on_the_sphere() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * (2 * np.pi / 16)
    z, turn = np.meshgrid(nodes, azimuth, indexing="ij")
    radius = np.sqrt(1 - z**2)
    direction = torch.tensor(np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=-1).reshape(-1, 3))
    area = np.repeat(weights * 2 * np.pi / 16, 16)
    basis = sh_basis(3, direction).numpy()
    assert_close(basis.T @ (area[:, None] * basis), np.eye(16), relative=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_lower_degree_is_the_start_of_a_higher_one(degree: int) -> None:
    direction = directions(20)
    lower, higher = sh_basis(degree, direction), sh_basis(3, direction)
    assert bool((lower == higher[:, : (degree + 1) ** 2]).all())


@pytest.mark.parametrize("degree", [-1, 4])
def test_a_degree_out_of_range_is_refused(degree: int) -> None:
    with pytest.raises(ValueError, match=f"not {degree}"):
        sh_basis(degree, directions(1))


def test_sh_colour_shows_the_rgb_it_was_made_from_in_every_direction() -> None:
    rgb = torch.rand(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    sh = torch.zeros(30, 16, 3, dtype=torch.float64)
    sh[:, 0] = sh_from_rgb(rgb)
    assert_close(sh_colour(sh, directions(30)), rgb, relative=1e-12)
    assert pytest.approx(0.28209479177387814, abs=1e-16) == SH_C0


def test_a_colour_below_zero_is_black_and_gets_no_gradient() -> None:
    sh = torch.full((1, 1, 3), -3.0, requires_grad=True)
    colour = sh_colour(sh, torch.zeros(1, 3))
    assert not colour.any()
    (gradient,) = torch.autograd.grad(colour.sum(), [sh])
    assert not gradient.any()


def test_colour_looks_from_the_camera_towards_the_mean() -> None:
    sh = torch.zeros(1, 4, 3)
    sh[0, 3] = 1.0  # the harmonic along -x
    gaussians = Gaussians(
        mean=torch.tensor([[4.0, 2.0, 1.0]]),
        quaternion=torch.tensor([[1.0, 0, 0, 0]]),
        log_scale=torch.zeros(1, 3),
        opacity_logit=torch.zeros(1),
        sh=sh,
    )
    along_x, against_x = torch.tensor([0.0, 2.0, 1.0]), torch.tensor([8.0, 2.0, 1.0])
    c1 = math.sqrt(3 / (4 * math.pi))
    assert_close(gaussians.colour(along_x), np.full((1, 3), 0.5 - c1))
    assert_close(gaussians.colour(against_x), np.full((1, 3), 0.5 + c1))
    assert gaussians.sh_degree == 1


def test_colour_gradients_are_those_of_finite_differences() -> None:
    random = torch.Generator().manual_seed(7)
    mean = torch.randn(5, 3, generator=random, dtype=torch.float64)
    sh = 0.1 * torch.randn(5, 16, 3, generator=random, dtype=torch.float64)
    centre = torch.tensor([0.3, -0.2, -4.0], dtype=torch.float64)

    def colour(mean: Tensor, sh: Tensor, centre: Tensor) -> Tensor:
        return Gaussians(mean, torch.ones(5, 4), torch.zeros(5, 3), torch.zeros(5), sh).colour(centre)

    leaves = [each.requires_grad_() for each in (mean, sh, centre)]
    assert torch.autograd.gradcheck(colour, leaves)


def test_a_grid_of_points_starts_as_round_gaussians_one_spacing_wide() -> None:
    spacing = 0.5
    grid = np.stack(np.meshgrid(*[np.arange(5.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * spacing
    rgb = np.random.default_rng(0).uniform(size=grid.shape)
    gaussians = initial_gaussians(grid, rgb, sh_degree=3, opacity=0.1)
    assert len(gaussians) == 125
    assert {name: tuple(each.shape) for name, each in gaussians.tensors().items()} == {
        "mean": (125, 3),
        "quaternion": (125, 4),
        "log_scale": (125, 3),
        "opacity_logit": (125,),
        "sh": (125, 16, 3),
        "gloss": (125,),
    }
    assert all(each.dtype == torch.float32 for each in gaussians.tensors().values())
    assert_close(gaussians.mean, grid)
    assert_close(gaussians.scale, np.full((125, 3), spacing))
    assert_close(gaussians.opacity, np.full(125, 0.1))
    assert_close(gaussians.colour(torch.tensor([0.0, 0.0, -50.0])), rgb)
    assert_close(gaussians.quaternion, np.tile([1.0, 0.0, 0.0, 0.0], (125, 1)))


def test_the_start_scale_is_the_root_mean_square_of_three_distances() -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0], [9.0, 9, 9]])
    scale = initial_gaussians(points, np.zeros((5, 3)), sh_degree=0).scale
    assert float(scale[0, 0]) == pytest.approx(math.sqrt((1 + 4 + 9) / 3), rel=1e-6)


def test_the_start_scale_is_clamped_for_coincident_and_for_stray_points() -> None:
    points = np.concatenate([np.zeros((4, 3)), [[100.0, 0, 0]]])
    scale = initial_gaussians(points, np.zeros((5, 3)), sh_degree=0).scale
    assert_close(scale[0], np.full(3, MIN_START_SCALE), absolute=1e-9)
    assert_close(scale[4], np.full(3, MAX_START_SCALE))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_points_than_neighbours_start_at_the_upper_clamp(count: int) -> None:
    points = np.arange(3.0 * count).reshape(count, 3)
    scale = initial_gaussians(points, np.zeros((count, 3)), sh_degree=0).scale
    assert_close(scale, np.full((count, 3), MAX_START_SCALE))


def test_the_start_does_not_share_memory_with_the_cloud() -> None:
    points = np.zeros((4, 3), np.float32)
    gaussians = initial_gaussians(points, points, sh_degree=0)
    points += 5
    assert not gaussians.mean.any()


@pytest.mark.parametrize(
    ("points", "rgb", "opacity", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), 0.1, "is empty"),
        (np.zeros((4, 2)), np.zeros((4, 3)), 0.1, r"shape \(4, 2\)"),
        (np.zeros((4, 3)), np.zeros((5, 3)), 0.1, r"colours \(5, 3\)"),
        (np.full((4, 3), np.nan), np.zeros((4, 3)), 0.1, "4 points with NaN"),
        (np.zeros((4, 3)), np.full((4, 3), np.inf), 0.1, "4 points with NaN or infinity"),
        (np.zeros((4, 3)), np.zeros((4, 3)), 1.0, "opacity: is 1.0"),
    ],
    ids=["empty", "two columns", "lengths", "NaN", "infinite colour", "opacity"],
)
def test_a_cloud_that_cannot_start_is_refused_by_name(
    points: np.ndarray, rgb: np.ndarray, opacity: float, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        initial_gaussians(points, rgb, sh_degree=0, opacity=opacity)
