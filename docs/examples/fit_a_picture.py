"""Fit Gaussians to a picture by gradient descent, without a GPU.

    python docs/examples/fit_a_picture.py [PICTURE] [--gaussians 3000] [--steps 400] [--out fit.png]

Without PICTURE the script draws one. It prints the PSNR while it fits, and writes target and fit side by side.
"""

import argparse

import numpy as np
import torch
from PIL import Image

from worker.raster.rasterize import rasterize


def landscape(width: int = 288, height: int = 192) -> Image.Image:
    """A sky with a sun above three rows of hills."""
    y, x = np.mgrid[:height, :width] / height
    picture = np.stack([0.95 - 0.5 * y, 0.65 - 0.2 * y, 0.45 + 0.4 * y], axis=-1)
    picture[np.hypot(x - 1.0, y - 0.35) < 0.15] = [1.0, 0.9, 0.5]
    for row, top in enumerate((0.5, 0.65, 0.8)):
        hills = y > top + 0.06 * np.sin((7 + 4 * row) * x + row) + 0.02 * np.sin(31 * x)
        picture[hills] = np.array([0.25, 0.35, 0.5]) * (1 - 0.3 * row)
    return Image.fromarray((255 * picture).astype(np.uint8))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", nargs="?", help="a small picture; without one, a landscape is drawn")
    parser.add_argument("--gaussians", type=int, default=3000)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--out", default="fit.png")
    arguments = parser.parse_args()
    picture = Image.open(arguments.picture).convert("RGB") if arguments.picture else landscape()
    target = torch.from_numpy(np.array(picture)).float() / 255
    height, width, _ = target.shape
    viewmats = torch.eye(4)[None]
    Ks = torch.tensor([[[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]]])

    # Start: Gaussians anywhere in the picture, at depths from 1 to 1.1, as wide as their mean distance, in its colours.
    torch.manual_seed(0)
    pixel = torch.rand(arguments.gaussians, 2) * torch.tensor([width, height])
    column, row = pixel.long().unbind(1)
    depth = 1 + 0.1 * torch.rand(arguments.gaussians, 1)
    means = torch.cat([(pixel - torch.tensor([width, height]) / 2) / width * depth, depth], dim=1)
    log_scales = torch.full_like(means, (height / width / arguments.gaussians) ** 0.5).log()
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(arguments.gaussians, 1)
    logits, colors = torch.zeros(arguments.gaussians), target[row, column].clone()
    rates = {means: 1e-3, quats: 1e-2, log_scales: 2e-2, logits: 5e-2, colors: 1e-2}
    optimizer = torch.optim.Adam([{"params": [each.requires_grad_()], "lr": rate} for each, rate in rates.items()])

    for step in range(arguments.steps + 1):
        view = rasterize(
            means, quats, log_scales.exp(), logits.sigmoid(), colors, viewmats, Ks, width=width, height=height
        )
        fit = view.colors[0]
        loss = (fit - target).abs().mean()
        if step % 50 == 0 or step == arguments.steps:
            psnr_db = -10 * torch.log10((fit.detach().clamp(0, 1) - target).square().mean())
            print(f"step {step:4}: PSNR {psnr_db:.2f} dB", flush=True)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    both = torch.cat([target, torch.ones(height, 4, 3), fit.detach().clamp(0, 1)], dim=1)
    Image.fromarray((255 * both).round().byte().numpy()).save(arguments.out)
    print(f"target | fit: {arguments.out}")


if __name__ == "__main__":
    main()
