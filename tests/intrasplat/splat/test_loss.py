"""The loss against its written gradients, and what it must not look at."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from intrasplat.splat.loss import LossSettings, colour_loss, inverse_depth_loss, training_loss

H, W = 6, 7


def frame(seed: int = 0) -> dict[str, Tensor]:
    """Rendered and recorded values of one frame, float64; some without tissue, depth or alpha."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random, dtype=torch.float64)

    alpha = 0.2 + 0.8 * uniform(H, W)
    alpha[0, :3] = 0.001
    true_depth = 50 + 20 * uniform(H, W)
    true_depth[1, :3] = 0
    return {
        "rgb": uniform(H, W, 3),
        "depth": alpha * (50 + 20 * uniform(H, W)),
        "alpha": alpha,
        "true_rgb": uniform(H, W, 3),
        "true_depth": true_depth,
        "tissue": uniform(H, W) > 0.3,
    }


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("delta", [0.0, 0.02])
def test_gradients_are_those_of_the_docstring(normalised: bool, delta: float) -> None:
    values = frame()
    settings = LossSettings(
        0.7, 1.3, normalised_depth=normalised, colour_huber_delta=delta, depth_huber_delta=delta / 10
    )
    rendered = [values[name].requires_grad_() for name in ("rgb", "depth", "alpha")]
    loss = training_loss(**values, settings=settings)
    got = torch.autograd.grad(loss.total, rendered, allow_unused=True)

    def slope(error: Tensor, delta: float) -> Tensor:
        return error.sign() if delta == 0 else (error / delta).clamp(-1, 1)

    rgb, z, a = (each.detach() for each in rendered)
    tissue, d = values["tissue"], values["true_depth"]
    valid = tissue & (d > 0)
    usable = valid & (a >= 0.01)
    inverse = a / z if normalised else 1 / z
    g = torch.where(usable, 1.3 / valid.sum() * slope(inverse - 1 / d, delta / 10), 0.0)
    colour = 0.7 / (3 * tissue.sum()) * slope(rgb - values["true_rgb"], delta) * tissue[..., None]
    torch.testing.assert_close(got[0], colour)
    torch.testing.assert_close(got[1], -g * inverse / z)
    torch.testing.assert_close(got[2] if got[2] is not None else torch.zeros_like(a), g / z if normalised else 0 * a)


def test_both_terms_are_plain_means_over_their_own_pixels() -> None:
    values = frame()
    tissue, d = values["tissue"], values["true_depth"]
    expected = (values["rgb"] - values["true_rgb"])[tissue].abs().mean()
    torch.testing.assert_close(colour_loss(values["rgb"], values["true_rgb"], tissue), expected)
    valid = tissue & (d > 0) & (values["alpha"] >= 0.01)
    errors = (1 / values["depth"][valid] - 1 / d[valid]).abs().sum() / (tissue & (d > 0)).sum()
    got = inverse_depth_loss(values["depth"], values["alpha"], d, tissue, normalised=False)
    torch.testing.assert_close(got, errors)


def test_a_right_render_costs_nothing() -> None:
    values = frame()
    values["alpha"] = torch.full((H, W), 0.8, dtype=torch.float64)
    values |= {"rgb": values["true_rgb"], "depth": 0.8 * values["true_depth"]}
    assert training_loss(**values, settings=LossSettings()).total < 1e-15
    assert training_loss(**values, settings=LossSettings(normalised_depth=False)).inverse_depth > 1e-3


def test_instruments_and_missing_depth_are_never_looked_at() -> None:
    values, poisoned = frame(), frame()
    outside = ~values["tissue"]
    poisoned["true_rgb"][outside] = 1e6
    poisoned["true_depth"][outside] = 1e-6
    poisoned["rgb"][outside] = -1e6
    settings = LossSettings()
    assert training_loss(**values, settings=settings).total == training_loss(**poisoned, settings=settings).total


def test_gradients_stay_finite_where_nothing_was_blended() -> None:
    values = frame()
    values["depth"][0] = 0.0
    values["alpha"][0] = 0.0
    rendered = [values[name].requires_grad_() for name in ("rgb", "depth", "alpha")]
    for gradient in torch.autograd.grad(training_loss(**values, settings=LossSettings()).total, rendered):
        assert torch.isfinite(gradient).all()


def test_a_frame_without_tissue_or_depth_costs_nothing() -> None:
    values = frame()
    values["tissue"] = torch.zeros(H, W, dtype=torch.bool)
    assert training_loss(**values, settings=LossSettings()).total == 0
    values = frame()
    values["true_depth"] = torch.zeros(H, W, dtype=torch.float64)
    assert training_loss(**values, settings=LossSettings()).inverse_depth == 0


def test_hubers_zone_is_continuous_and_tends_to_the_plain_loss() -> None:
    values = frame()
    arguments = values["rgb"], values["true_rgb"], values["tissue"]
    plain = colour_loss(*arguments)
    torch.testing.assert_close(colour_loss(*arguments, delta=1e-9), plain)
    error = torch.full((1, 1, 3), 0.1, dtype=torch.float64)
    one = torch.ones(1, 1, dtype=torch.bool)
    below, above = (colour_loss(error * scale, 0 * error, one, delta=0.1) for scale in (1 - 1e-9, 1 + 1e-9))
    assert abs(float(above - below)) < 1e-9


def test_negative_weights_are_refused() -> None:
    with pytest.raises(ValueError, match="depth_weight"):
        LossSettings(depth_weight=-1.0)
