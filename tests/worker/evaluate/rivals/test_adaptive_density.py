"""Gaussians that are split and dropped."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from contract.wire.errors import TrainingDiverged
from worker.evaluate.rivals.adaptive_density import AdaptiveDensity
from worker.methods.method import DensifySettings
from worker.raster import Camera
from worker.raster.reference import project

SETTINGS = DensifySettings(max_count=20)


def five() -> list[nn.Parameter]:
    """Five Gaussians, the second nearly transparent."""
    mean = torch.tensor([[0.0, 0, 50], [1, 2, 55], [-3, 1, 60], [4, -2, 65], [0, 3, 70]])
    quaternion = torch.tensor([[0.8, 0.6, 0, 0]]).repeat(5, 1)
    log_scale = torch.log(torch.tensor([[0.1, 0.2, 0.3]])).repeat(5, 1)
    opacity_logit = torch.tensor([[2.0], [-6], [1], [1], [0]])
    colour, harmonics = torch.arange(15.0).reshape(5, 1, 3), torch.zeros(5, 3, 3)
    return [nn.Parameter(each) for each in (mean, quaternion, log_scale, opacity_logit, colour, harmonics)]


def untrained(parameters: list[Tensor] | list[nn.Parameter]) -> torch.optim.Optimizer:
    return torch.optim.Adam([{"params": [each]} for each in parameters])


def trained(parameters: list[nn.Parameter]) -> torch.optim.Optimizer:
    """An optimiser whose moments differ from Gaussian to Gaussian, after a step that changes next to nothing."""
    optimizer = torch.optim.Adam([{"params": [each]} for each in parameters], lr=1e-12)
    for each in parameters:
        weight = torch.arange(1.0, 6).reshape(-1, *[1] * (each.ndim - 1))
        each.grad = (weight * torch.ones_like(each)).detach()
    optimizer.step()
    return optimizer


CAMERA = Camera(200.0, 180.0, 32.0, 24.0, 64, 48, np.eye(4))


def pull(density: AdaptiveDensity, gradient: Tensor, mean: Tensor) -> None:
    density.observe(gradient, mean.detach(), CAMERA)


def test_the_pull_is_the_mean_gradient_of_the_projection_over_the_steps_that_saw_it() -> None:
    turn = np.eye(4)
    turn[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    camera = dataclasses.replace(CAMERA, camera_from_world=turn)
    parameters = [each.detach().double().requires_grad_() for each in five()]
    mean, quaternion, log_scale, opacity_logit = parameters[:4]
    projected = project(mean, quaternion, log_scale.exp(), torch.sigmoid(opacity_logit[:, 0]), camera)
    weight = torch.tensor([[1.0, 2], [0, 0], [3, -1], [0.5, 0], [0, 1]], dtype=torch.float64)
    gradient, of_mean2d = torch.autograd.grad((projected.mean2d * weight).sum(), [mean, projected.mean2d])
    density = AdaptiveDensity(SETTINGS, untrained(parameters))
    density.observe(gradient, mean.detach(), camera)
    density.observe(3 * gradient, mean.detach(), camera)
    density.observe(0 * gradient, mean.detach(), camera)
    want = 2 * (of_mean2d * torch.tensor([32.0, 24.0])).norm(dim=1)
    torch.testing.assert_close(density.pull, want)
    assert density.pull[1] == 0


def test_it_watches_the_gradient_by_what_the_camera_sees() -> None:
    deformed = torch.cat([each.detach() for each in five()[:4]], 1).requires_grad_()
    optimizer = trained(five())
    watching, told = AdaptiveDensity(SETTINGS, optimizer), AdaptiveDensity(SETTINGS, optimizer)
    watching.watch(deformed, CAMERA)
    weight = torch.arange(55.0).reshape(5, 11).sin()
    (deformed * weight).sum().backward()  # type: ignore[no-untyped-call]
    told.observe(weight[:, :3], deformed.detach()[:, :3], CAMERA)
    torch.testing.assert_close(watching.pull, told.pull)
    assert bool((told.pull > 0).all())


def test_a_transparent_gaussian_goes_and_one_that_is_pulled_becomes_two_smaller_ones() -> None:
    parameters = five()
    optimizer = trained(parameters)
    density, gradient = AdaptiveDensity(SETTINGS, optimizer), torch.zeros(5, 3)
    gradient[2, 0] = 1.0
    gradient[3, 0] = 1e-6
    pull(density, gradient, parameters[0])
    old = [each.detach().clone() for each in parameters]
    new = density.split(torch.Generator().manual_seed(0))
    assert [len(each) for each in new] == [5] * 6
    assert [group["params"][0] for group in optimizer.param_groups] == new
    for each, before in zip(new, old, strict=True):
        torch.testing.assert_close(each[:3], before[[0, 3, 4]])
        assert each.is_leaf
        assert each.requires_grad
    mean, quaternion, log_scale, opacity_logit, colour, _ = (each.detach()[3:] for each in new)
    assert 0 < float((mean - old[0][2]).norm(dim=1).min()) < float((mean - old[0][2]).norm(dim=1).max()) < 1.5
    torch.testing.assert_close(log_scale, old[2][[2, 2]] - np.log(1.6))
    for each, index in ((quaternion, 1), (opacity_logit, 3), (colour, 4)):
        torch.testing.assert_close(each, old[index][[2, 2]])
    for each in new:
        moment = optimizer.state[each]["exp_avg"].flatten(1)[:, 0]
        torch.testing.assert_close(moment, torch.tensor([0.1, 0.4, 0.5, 0.0, 0.0]))
        assert optimizer.state[each]["step"] == 1
    assert len(optimizer.state) == 6, "nothing is kept of the old ones"
    assert bool((density.pull == 0).all())


def test_children_lie_as_their_parent_s_density_says() -> None:
    parameters = [each.detach()[[0] * 4000] for each in five()]
    parameters[2][:] = torch.log(torch.tensor([0.5, 1e-6, 0.1]))
    parameters = [nn.Parameter(each) for each in parameters]
    density = AdaptiveDensity(DensifySettings(), untrained(parameters))
    pull(density, torch.ones(4000, 3), parameters[0])
    offset = density.split(torch.Generator().manual_seed(0))[0].detach() - torch.tensor([0.0, 0, 50])
    assert len(offset) == 8000
    turned = torch.tensor([0.0, -0.96, 0.28])  # where the quaternion (0.8, 0.6, 0, 0) takes the third axis
    assert abs(float(offset[:, 0].std()) - 0.5) < 0.02
    assert abs(float((offset @ turned).std()) - 0.1) < 0.004
    assert float((offset @ torch.tensor([0.0, 0.28, 0.96])).abs().max()) < 1e-4


def test_there_is_room_for_so_many_and_those_pulled_hardest_have_it() -> None:
    parameters = five()
    density = AdaptiveDensity(DensifySettings(max_count=5), trained(parameters))
    pull(density, torch.tensor([[1.0, 0, 0], [9, 0, 0], [3, 0, 0], [2, 0, 0], [0, 0, 0]]), parameters[0])
    colour = density.split(torch.Generator())[4].detach()[:, 0, 0]
    torch.testing.assert_close(colour, torch.tensor([0.0, 9, 12, 6, 6]))


def test_nothing_left_is_an_error() -> None:
    parameters = five()
    with torch.no_grad():
        parameters[3].fill_(-9.0)
    density = AdaptiveDensity(SETTINGS, trained(parameters))
    with pytest.raises(TrainingDiverged, match="transparent"):
        density.split(torch.Generator())
