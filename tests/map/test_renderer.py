# SPDX-License-Identifier: Apache-2.0
import numpy as np
import torch
import warp as wp

from ggwarp import lie
from ggwarp.map.gaussians import GaussianBatch, GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.ops.reference.render import render as reference_render
from ggwarp.types import Camera

CAMERA = Camera(50, 37, 45.0, 44.0, 24.0, 19.0)


def scene(count: int, rng: np.random.Generator) -> GaussianBatch:
    means = rng.uniform([-0.6, -0.5, 1.0], [0.6, 0.5, 2.0], (count, 3)).astype(np.float32)
    return GaussianBatch(
        means,
        rng.normal(size=(count, 4)).astype(np.float32),
        np.log(rng.uniform(0.02, 0.1, (count, 3))).astype(np.float32),
        rng.normal(size=count).astype(np.float32),
        rng.normal(size=(count, 3)).astype(np.float32),
        rng.normal(size=(count, 16)).astype(np.float32),
    )


def made(device: str, rows: GaussianBatch) -> tuple[GaussianMap, Renderer]:
    gaussians = GaussianMap(device=device, has_identity=True, capacity=16)
    renderer = Renderer(gaussians, CAMERA)
    gaussians.append(rows)
    return gaussians, renderer


def test_the_picture_is_the_oracle_s(device: str, rng: np.random.Generator) -> None:
    rows = scene(60, rng)
    _, renderer = made(device, rows)
    T_wc = lie.se3_exp([0.02, -0.01, 0.03, 0.01, 0.05, -0.02])

    renderer.forward(renderer.pose_array(T_wc))

    tensors = [
        torch.tensor(getattr(rows, n), dtype=torch.float64)
        for n in ("means", "quats", "log_scales", "opacity_logits", "colours", "identities")
    ]
    image, transmittance, *_ = reference_render(*tensors, torch.tensor(lie.inverse(T_wc)), CAMERA)
    np.testing.assert_allclose(renderer.plane(renderer.image), image.numpy(), atol=2e-4)
    np.testing.assert_allclose(renderer.plane(renderer.transmittance), transmittance.numpy(), atol=2e-4)


def test_room_grows_with_the_map_and_the_pairs(device: str, rng: np.random.Generator) -> None:
    gaussians, renderer = made(device, scene(10, rng))
    pose = renderer.pose_array(np.eye(4))
    big = scene(300, rng)
    big.log_scales[:] = np.log(0.3)
    gaussians.append(big)

    renderer.forward(pose)
    renderer.d_image.fill_(1e-3)
    renderer.adjoint(pose)

    gradient = renderer.gradients.means.numpy()[: gaussians.count]
    assert np.isfinite(gradient).all() and (gradient != 0).any()


def test_an_empty_map_is_black(device: str) -> None:
    renderer = Renderer(GaussianMap(device=device, has_identity=True), CAMERA)
    pose = renderer.pose_array(np.eye(4))
    renderer.forward(pose)
    renderer.adjoint(pose)
    assert not renderer.image.numpy().any()
    assert (renderer.plane(renderer.transmittance) == 1.0).all()
    assert not renderer.plane(renderer.median_depth).any()


def test_arrays_without_padding_have_the_camera_s_size(device: str) -> None:
    renderer = Renderer(GaussianMap(device=device, has_identity=False), CAMERA)
    assert renderer.image.shape == (4, 48, 64)
    assert renderer.plane(renderer.image).shape == (4, 37, 50)
    assert wp.get_device(device) == renderer.image.device
