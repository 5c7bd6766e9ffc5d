# SPDX-License-Identifier: Apache-2.0
"""Fit Gaussians to one picture with torch's own optimiser: the kernels are torch functions.

python examples/train_one_image.py
"""

import torch

from ggwarp import Camera, SyntheticOffice
from ggwarp.ops import render, ssim


def main(count: int = 3000, steps: int = 100, scale: float = 0.15) -> float:
    # A picture [3, h, w] and its camera.
    frame = SyntheticOffice(frames=120, scale=scale)[0]
    target = torch.from_numpy(frame.rgb).permute(2, 0, 1).float().contiguous() / 255.0
    _, height, width = target.shape
    camera = Camera(width, height, width / 2, width / 2, (width - 1) / 2, (height - 1) / 2)

    # Gaussians on a plane at 2 m, all grey: [n, 3] means, [n, 4] quaternions (w first), and so on.
    torch.manual_seed(0)
    x, y = torch.rand(count) * 4 - 2, (torch.rand(count) * 4 - 2) * height / width
    means = torch.stack([x, y, torch.full((count,), 2.0)], dim=1)
    parameters = {
        "means": (means, 2e-3),
        "quats": (torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1), 1e-3),
        "log_scales": (torch.full((count, 3), 0.05).log(), 2e-2),
        "opacity_logits": (torch.zeros(count), 5e-2),
        "colours": (torch.zeros(count, 3), 5e-2),
    }
    tensors = {name: tensor.requires_grad_() for name, (tensor, _) in parameters.items()}
    optimiser = torch.optim.Adam([{"params": [t], "lr": lr} for t, lr in parameters.values()], eps=1e-15)

    loss = torch.zeros(())
    for step in range(steps):
        # image [4, h, w]: colour and depth; gradients flow to every parameter.
        image, _, _ = render(**tensors, identities=None, T_cw=torch.eye(4), camera=camera)
        colour = image[:3].contiguous()
        loss = 0.8 * (colour - target).abs().mean() + 0.2 * (1 - ssim(colour, target))  # GG-SLAM eq. (6)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step % 20 == 0:
            print(f"step {step}: loss {loss.item():.4f}")
    return loss.item()


if __name__ == "__main__":
    main()
