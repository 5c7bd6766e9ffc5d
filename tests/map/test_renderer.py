# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import PARAMETERS, GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.ops.reference.render import render as reference_render
from ggwarp.runtime.graphs import GraphCache

CAMERA = Camera(50, 37, 45.0, 44.0, 24.0, 19.0)


def scene(count: int, rng: np.random.Generator) -> Gaussians:
    means = rng.uniform([-0.6, -0.5, 1.0], [0.6, 0.5, 2.0], (count, 3)).astype(np.float32)
    return Gaussians(
        means,
        rng.normal(size=(count, 4)).astype(np.float32),
        np.log(rng.uniform(0.02, 0.1, (count, 3))).astype(np.float32),
        rng.normal(size=count).astype(np.float32),
        rng.normal(size=(count, 3)).astype(np.float32),
        identities=rng.normal(size=(count, 16)).astype(np.float32),
    )


def made(device: str, rows: Gaussians) -> tuple[GaussianMap, Renderer]:
    gaussians = GaussianMap(device=device, has_identity=True, capacity=16)
    renderer = Renderer(gaussians, CAMERA)
    gaussians.append(rows)
    return gaussians, renderer


def test_the_picture_is_the_oracle_s(device: str, rng: np.random.Generator) -> None:
    rows = scene(60, rng)
    _, renderer = made(device, rows)
    T_wc = se3.se3_exp([0.02, -0.01, 0.03, 0.01, 0.05, -0.02])

    renderer.forward(renderer.pose_array(T_wc))

    tensors = [
        torch.tensor(getattr(rows, n), dtype=torch.float64)
        for n in ("means", "quats", "log_scales", "opacity_logits", "colours", "identities")
    ]
    image, transmittance, *_ = reference_render(*tensors, torch.tensor(se3.inverse(T_wc)), CAMERA)
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


def test_the_identity_may_be_kept_from_shaping(device: str, rng: np.random.Generator) -> None:
    gaussians, renderer = made(device, scene(60, rng))
    alone = Renderer(gaussians, CAMERA, identity_shapes=False)
    pose = renderer.pose_array(np.eye(4))
    for r in (renderer, alone):
        r.forward(pose)
        r.d_image[4:].fill_(1e-3)
        r.adjoint(pose)

    identities = renderer.gradients.identities.numpy()[:60]
    assert identities.any() and renderer.gradients.means.numpy()[:60].any()
    assert np.array_equal(alone.gradients.identities.numpy()[:60], identities)
    assert not alone.gradients.means.numpy()[:60].any()


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


def faint_scene(count: int, rng: np.random.Generator) -> Gaussians:
    """Well separated in depth and faint: no pixel is near a threshold of alpha or of the transmittance."""
    z = 1.0 + 0.07 * rng.permutation(count)
    xy = rng.uniform(-0.3, 0.3, (count, 2)) * z[:, None]
    rows = scene(count, rng)
    rows.means[:] = np.column_stack([xy, z])
    rows.log_scales[:] = np.log(rng.uniform(0.05, 0.2, (count, 3)))
    rows.opacity_logits[:] = rng.uniform(-2.0, 0.5, count)
    return rows


@pytest.mark.parametrize("planes", [[0, 1, 2], [3], []], ids=["colour", "depth", "transmittance"])
@pytest.mark.parametrize("pose", [[0.0] * 6, [0.1, -0.05, 0.2, 0.05, -0.1, 0.3]])
def test_the_pose_gradient_is_that_of_finite_differences(
    device: str, rng: np.random.Generator, planes: list[int], pose: list[float]
) -> None:
    rows = faint_scene(40, rng)
    gaussians, renderer = made(device, rows)
    lean = Renderer(gaussians, CAMERA, identity=False)
    T_cw = se3.se3_exp(pose)
    weights = np.zeros((4, CAMERA.height, CAMERA.width))
    weights[planes] = rng.normal(size=(len(planes), CAMERA.height, CAMERA.width)) + 0.5
    seen_weight = 0.0 if planes else 1.0
    T = lean.pose_array(se3.inverse(T_cw))

    for r in (lean, renderer):
        r.forward(T)
        d_image = np.zeros(r.image.shape, np.float32)
        d_image[:4, : CAMERA.height, : CAMERA.width] = weights
        r.d_image.assign(d_image)
        d_transmittance = np.zeros(r.transmittance.shape, np.float32)
        d_transmittance[: CAMERA.height, : CAMERA.width] = seen_weight
        r.d_transmittance.assign(d_transmittance)
    lean.adjoint_pose(T)
    renderer.adjoint(T, pose=True)

    def loss(tau: np.ndarray) -> float:
        tensors = [torch.tensor(getattr(rows, n), dtype=torch.float64) for n in list(PARAMETERS)[:5]]
        T_moved = torch.tensor(se3.se3_exp(tau) @ T_cw)
        image, transmittance, _ = reference_render(*tensors, None, T_moved, CAMERA)
        return float((image * torch.tensor(weights)).sum() + seen_weight * transmittance.sum())

    # So small that no pixel crosses the threshold of alpha on the way.
    h = 1e-8
    expected = np.array([(loss(h * e) - loss(-h * e)) / (2.0 * h) for e in np.eye(6)])
    scale = np.linalg.norm(expected)
    for r in (lean, renderer):
        np.testing.assert_allclose(r.d_pose.numpy()[0], expected, atol=2e-3 * scale)


def test_without_identities_colour_and_depth_are_the_same(device: str, rng: np.random.Generator) -> None:
    gaussians, renderer = made(device, scene(60, rng))
    lean = Renderer(gaussians, CAMERA, identity=False)
    T = renderer.pose_array(np.eye(4))
    renderer.forward(T)
    lean.forward(T)
    assert lean.image.shape[0] == 4 and lean.gradients.identities is None
    np.testing.assert_allclose(lean.image.numpy(), renderer.image.numpy()[:4], atol=1e-5)


def test_a_recording_that_lacks_slots_says_so(device: str, rng: np.random.Generator) -> None:
    gaussians = GaussianMap(device=device, has_identity=True, capacity=64)
    renderer = Renderer(gaussians, CAMERA)
    big = scene(60, rng)
    big.log_scales[:] = np.log(0.3)
    renderer.forward(pose := renderer.pose_array(np.eye(4)))  # loads kernels
    gaussians.append(big)
    assert renderer.tiles.capacity < 60 * 6
    graphs, before = GraphCache(device), renderer.allocation
    for _ in range(2):
        graphs.run("view", lambda: record(renderer, pose), arrays=before)
    image = renderer.image.numpy().copy()
    assert renderer.make_room() and renderer.allocation > before
    renderer.render(np.eye(4))
    assert not renderer.make_room()
    assert (image != renderer.image.numpy()).any(), "the farthest were left out"


def record(renderer: Renderer, pose: wp.array) -> None:
    if renderer.image.device.is_capturing:
        renderer.forward(pose)


def test_a_window_of_the_picture_is_that_part_to_the_bit(device: str, rng: np.random.Generator) -> None:
    _, renderer = made(device, scene(80, rng))
    renderer.render(np.eye(4))
    whole = renderer.plane(renderer.image), renderer.plane(renderer.median_depth)
    assert np.abs(whole[0][:3]).max() > 0.1

    renderer.render(np.eye(4), window=(16, 16, 48, 37))

    for before, after in zip(whole, (renderer.image, renderer.median_depth), strict=True):
        np.testing.assert_array_equal(renderer.plane(after)[..., 16:, 16:48], before[..., 16:, 16:48])
    shown = renderer.plane(renderer.transmittance)
    assert shown[16:, 16:48].min() < 0.9
    shown[16:, 16:48] = 1.0
    assert (shown == 1.0).all()
    renderer.render(np.eye(4))
    np.testing.assert_array_equal(renderer.plane(renderer.image), whole[0])
