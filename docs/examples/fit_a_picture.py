"""Fit Gaussians to a picture by gradient descent, without a GPU. Prints the PSNR, and writes target and fit."""

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import intrasplat as isp

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("picture", nargs="?", default=Path(__file__).parents[1] / "images" / "landscape.png")
parser.add_argument("--gaussians", type=int, default=3000)
parser.add_argument("--steps", type=int, default=400)
parser.add_argument("--out", default="fit.png")
options = parser.parse_args()
torch.set_num_threads(1)  # the kernels have threads of their own
target = torch.from_numpy(np.array(Image.open(options.picture).convert("RGB"))).float() / 255
height, width, _ = target.shape
K = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])

# Start: Gaussians anywhere in the picture, at depths from 1 to 1.1, as wide as their mean distance, in its colours.
torch.manual_seed(0)
pixel = torch.rand(options.gaussians, 2) * torch.tensor([width, height])
depth = 1 + 0.1 * torch.rand(options.gaussians, 1)
means = torch.cat([(pixel - torch.tensor([width, height]) / 2) / width * depth, depth], dim=1)
quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(options.gaussians, 1)
log_scales = torch.full_like(means, (height / width / options.gaussians) ** 0.5).log()
logits, colors = torch.zeros(options.gaussians), target[pixel[:, 1].long(), pixel[:, 0].long()].clone()
rates = {means: 1e-3, quats: 1e-2, log_scales: 2e-2, logits: 5e-2, colors: 1e-2}
optimizer = torch.optim.Adam([{"params": [each.requires_grad_()], "lr": rate} for each, rate in rates.items()])

for step in range(options.steps + 1):
    gaussians = (means, quats, log_scales.exp(), logits.sigmoid(), colors)
    fit = isp.rasterize(*gaussians, torch.eye(4)[None], K[None], width=width, height=height).colors[0]
    if step % 50 == 0 or step == options.steps:
        psnr_db = -10 * (fit.detach().clamp(0, 1) - target).square().mean().log10()
        print(f"step {step:4}: PSNR {psnr_db:.2f} dB", flush=True)
    optimizer.zero_grad()
    (fit - target).abs().mean().backward()
    optimizer.step()

both = torch.cat([target, torch.ones(height, 4, 3), fit.detach().clamp(0, 1)], dim=1)
Image.fromarray((255 * both).round().byte().numpy()).save(options.out)
