# SPDX-License-Identifier: Apache-2.0
"""gswarp (Apache-2.0, Warp kernels, 3 channels) on the benchmark's scene, beside ours with 4 channels.

    python -m gpu_day.gswarp_peer [WIDTHxHEIGHT GAUSSIANS]

Forward and backward pass, milliseconds; needs ``gswarp`` and CUDA.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from benchmarking.inputs.scene import covering_size, scene_camera, scene_gaussians
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.runtime import loading
from ggwarp.runtime.graphs import GraphCache
from ggwarp.types import Float32

_NEAR, _FAR = 0.01, 100.0
_DEVICE = "cuda:0"


def _timed(work: Callable[[], object], rounds: int = 20, batch: int = 5) -> float:
    """Return the median time of ``work``, milliseconds."""
    for _ in range(batch):
        work()
    times = []
    for _ in range(rounds):
        torch.cuda.synchronize()
        started = time.perf_counter()
        for _ in range(batch):
            work()
        torch.cuda.synchronize()
        times.append((time.perf_counter() - started) / batch)
    return 1e3 * float(np.median(times))


def ours(batch: Gaussians, camera: Camera, d_image: Float32) -> tuple[Callable[[], object], Float32]:
    """Return our pass as a recorded graph, and its picture [3, h, w]."""
    gaussians = GaussianMap(device=_DEVICE, has_identity=False, capacity=len(batch.means))
    gaussians.append(batch)
    renderer = Renderer(gaussians, camera, identity=False)
    T = renderer.pose_array(np.eye(4))
    renderer.provide(T)
    padded = np.zeros(renderer.d_image.shape, np.float32)
    padded[:3, : camera.height, : camera.width] = d_image
    renderer.d_image.assign(padded)
    graphs = GraphCache(_DEVICE)

    def work() -> None:
        renderer.forward(T)
        renderer.adjoint(T)

    def run() -> None:
        graphs.run("pass", work, arrays=renderer.allocation)

    run()
    return run, renderer.plane(renderer.image)[:3]


def theirs(batch: Gaussians, camera: Camera, d_image: Float32) -> Callable[[], torch.Tensor]:
    """Return gswarp's forward and backward pass, which returns its picture."""
    from gswarp import (  # pyright: ignore[reportMissingImports]
        GaussianRasterizationSettings,
        GaussianRasterizer,
    )

    def tensor(array: Any) -> torch.Tensor:
        return torch.tensor(np.asarray(array, np.float32), device=_DEVICE, requires_grad=True)

    width, height = camera.width, camera.height
    P = torch.zeros(4, 4)
    P[0, 0], P[1, 1] = 2 * camera.fx / width, 2 * camera.fy / height
    P[0, 2], P[1, 2] = 2 * (camera.cx + 0.5) / width - 1, 2 * (camera.cy + 0.5) / height - 1
    P[2, 2], P[2, 3], P[3, 2] = _FAR / (_FAR - _NEAR), -_FAR * _NEAR / (_FAR - _NEAR), 1.0
    settings = GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=width / (2 * camera.fx),
        tanfovy=height / (2 * camera.fy),
        bg=torch.zeros(3, device=_DEVICE),
        scale_modifier=1.0,
        viewmatrix=torch.eye(4, device=_DEVICE),
        projmatrix=P.T.contiguous().to(_DEVICE),
        sh_degree=0,
        campos=torch.zeros(3, device=_DEVICE),
        prefiltered=False,
        auto_tune_verbose=False,
    )
    rasterise = GaussianRasterizer(settings)
    means, quats, scales = tensor(batch.means), tensor(batch.quats), tensor(np.exp(batch.log_scales))
    colours = tensor(np.maximum(0.5 + SH_C0 * batch.colours, 0.0))
    opacities = tensor(1.0 / (1.0 + np.exp(-batch.opacity_logits[:, None])))
    means2d = torch.zeros_like(means, requires_grad=True)
    incoming = torch.tensor(d_image, device=_DEVICE)

    def work() -> torch.Tensor:
        image = rasterise(
            means3D=means,
            means2D=means2d,
            opacities=opacities,
            colors_precomp=colours,
            scales=scales,
            rotations=quats,
        )[0]
        torch.autograd.grad(image, [means, quats, scales, opacities, colours], incoming)
        return image

    return work


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    loading.init_quietly()
    size, count = arguments or ("1200x680", "300000")
    width, height = map(int, size.split("x"))
    camera = scene_camera(width, height)
    batch = scene_gaussians(int(count), camera, size=covering_size(int(count), width, height), identity=False)
    d_image = np.random.default_rng(2).normal(size=(3, height, width)).astype(np.float32)
    own, picture = ours(batch, camera, d_image)
    print(f"ours, 4 channels, recorded: {_timed(own):.3f} ms", flush=True)
    peer = theirs(batch, camera, d_image)
    image = peer().detach().cpu().numpy()
    error = np.linalg.norm(image - picture) / np.linalg.norm(picture)
    print(f"pictures differ by relative L2 {error:.2e}", flush=True)
    print(f"gswarp, 3 channels, autograd: {_timed(peer):.3f} ms", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
