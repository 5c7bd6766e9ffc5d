# SPDX-License-Identifier: Apache-2.0
"""The public render op: a tutorial first, then the oracle, gradients and faulty input."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.ops import render
from ggwarp.ops.reference import render as oracle

CAMERA = Camera(37, 21, 30.0, 32.0, 20.3, 8.2)
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "colours", "identities")
T_CW = se3.se3_exp([0.1, -0.2, 0.3, 0.2, -0.1, 0.3])


def make_scene(n, *, seed=0, spread=0.45):
    """Faint, well separated in depth: no pixel comes near a threshold of T, no alpha near 0.99."""
    rng = np.random.default_rng(seed)
    points = np.stack(
        [rng.uniform(-spread, spread, n), rng.uniform(-spread, spread, n), rng.permutation(n) * 0.07 + 1.0],
        -1,
    )
    points[:, :2] *= points[:, 2:]
    T_wc = se3.inverse(T_CW)
    scene = (
        points @ T_wc[:3, :3].T + T_wc[:3, 3],
        rng.normal(size=(n, 4)),
        np.log(rng.uniform(0.03, 0.2, (n, 3))),
        rng.uniform(-2.0, 1.0, n),
        rng.uniform(-1.5, 1.5, (n, 3)),
        rng.normal(size=(n, 16)),
    )
    return [torch.tensor(x.reshape(n, *x.shape[1:])) for x in scene]


def on(device, tensors, *, grad=True):
    return [t.to(device, torch.float32).clone().requires_grad_(grad) for t in tensors]


def pose(device, dtype=torch.float32):
    return torch.tensor(T_CW, dtype=dtype, device=device)


def relative(actual, expected):
    actual, expected = actual.detach().cpu().double(), expected.detach().double()
    return float((actual - expected).norm() / expected.norm())


def test_fits_a_picture(device):
    """The example: Gaussians take the colours of a target picture, by an ordinary torch optimiser."""
    with torch.no_grad():
        target, _, _ = render(*on(device, make_scene(20), grad=False), pose(device), CAMERA)
    parameters = on(device, make_scene(20))
    with torch.no_grad():
        parameters[4].zero_()
    optimiser = torch.optim.Adam([parameters[4]], lr=0.1)
    losses = []
    for _ in range(40):
        image, _transmittance, _median_depth = render(*parameters, pose(device), CAMERA)
        loss = (image - target).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]


@pytest.mark.parametrize("identity", [True, False])
def test_renders_as_the_oracle(device, identity):
    scene = make_scene(40)
    if not identity:
        scene[5] = None
    expected = oracle.render(*scene, pose("cpu", torch.float64), CAMERA)
    actual = render(*(None if t is None else t.to(device).float() for t in scene), pose(device), CAMERA)
    assert actual[0].shape == (20 if identity else 4, 21, 37)
    assert actual[1].shape == actual[2].shape == (21, 37)
    assert 0 < (expected[2] > 0).float().mean() < 1
    for a, e in zip(actual, expected, strict=True):
        assert relative(a, e) < 1e-4


def test_gradients_agree_with_the_oracle(device):
    scene = make_scene(40, seed=2)
    weights = [torch.randn(s, generator=torch.Generator().manual_seed(1)) for s in ((20, 21, 37), (21, 37))]
    exact = [t.clone().requires_grad_() for t in scene]
    exact_tau = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    image, transmittance, _ = oracle.render(*exact, pose("cpu", torch.float64), CAMERA, tau=exact_tau)
    ((image * weights[0]).sum() + (transmittance * weights[1]).sum()).backward()
    ours = on(device, scene)
    tau = torch.zeros(6, device=device, requires_grad=True)
    image, transmittance, _ = render(*ours, pose(device), CAMERA, tau=tau)
    ((image * weights[0].to(device)).sum() + (transmittance * weights[1].to(device)).sum()).backward()
    for name, a, e in zip((*FIELDS, "tau"), (*ours, tau), (*exact, exact_tau), strict=True):
        actual, expected = a.grad.cpu().double(), e.grad
        assert relative(actual, expected) < 5e-3, name
        assert torch.cosine_similarity(actual.flatten(), expected.flatten(), dim=0) >= 0.999, name
        assert abs((actual - expected).sum()) < 5e-3 * expected.abs().sum(), name


def test_gradients_agree_with_finite_differences(device):
    """Wide splats: the edge where alpha falls under 1/255 lies off the picture, so the loss is smooth."""
    scene = make_scene(8, seed=4, spread=0.2)
    scene[2] += np.log(10.0)
    scene[3] = scene[3] * 0.2 - 0.8
    scene = on(device, scene)
    weights = torch.randn((20, 21, 37), generator=torch.Generator().manual_seed(1)).to(device)

    def loss(parameters, T_cw, tau=None):
        T = torch.tensor(T_cw, dtype=torch.float32, device=device)
        image, transmittance, _ = render(*parameters, T, CAMERA, tau=tau)
        return (image * weights).double().sum() + transmittance.double().sum()

    tau = torch.zeros(6, device=device, requires_grad=True)
    loss(scene, T_CW, tau).backward()
    h = 3e-3
    with torch.no_grad():
        for k, name in enumerate(FIELDS):
            direction = torch.randn(scene[k].shape, generator=torch.Generator().manual_seed(k)).to(device)
            ends = [
                loss([p + s * h * direction if p is scene[k] else p for p in scene], T_CW) for s in (1, -1)
            ]
            expected = float((scene[k].grad * direction).sum())
            assert float(ends[0] - ends[1]) / (2 * h) == pytest.approx(expected, rel=0.02), name
        numeric = [
            float(loss(scene, se3.se3_exp(s) @ T_CW) - loss(scene, se3.se3_exp(-s) @ T_CW)) / (2 * h)
            for s in h * np.eye(6)
        ]
    assert relative(tau.grad, torch.tensor(numeric)) < 0.02


def test_a_slanted_plane_of_discs_renders_the_planes_depth(device):
    """Splats of one depth each bend it towards the camera, as the nearer ones win."""
    camera = Camera(40, 30, 100.0, 100.0, 19.5, 14.5)
    angle = np.deg2rad(50.0)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(angle), np.sin(angle)]])
    steps = np.arange(-1.0, 1.0, 0.05)
    means = [0.0, 0.0, 2.0] + np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) @ axes
    n = len(means)
    scene = (
        torch.tensor(means),
        torch.tensor([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]).repeat(n, 1),
        torch.tensor(np.log([0.06, 0.06, 0.0005])).repeat(n, 1),
        torch.full((n,), 0.5, dtype=torch.float64),
        torch.zeros((n, 3), dtype=torch.float64),
    )
    T_cw = torch.eye(4, dtype=torch.float64)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    normal = np.cross(*axes)
    plane = torch.tensor(2.0 * normal[2] / (rays @ normal))

    def errors(depth):
        return (depth.detach().cpu().double() - plane).abs()

    image, transmittance, median = render(
        *(t.to(device).float() for t in scene), None, T_cw.to(device).float(), camera
    )
    splats = oracle.project(*scene, None, T_cw, camera)
    flat, behind, _ = oracle.composite(
        splats.means2d,
        splats.conics,
        splats.slopes * 0.0,
        splats.depths,
        splats.features,
        width=40,
        height=30,
    )
    assert transmittance.max() < 0.01
    bent = errors(flat[3] / (1.0 - behind))
    straight = errors(image[3] / (1.0 - transmittance))
    assert bent.mean() > 0.05
    assert straight.mean() < 0.01 and straight.max() < 0.015
    assert errors(median).max() < 0.02


def test_uses_the_tensors_own_memory(device):
    """Strided input is taken, and contiguous input is not copied: its values may change between calls."""
    scene = on(device, make_scene(10), grad=False)
    first = render(*scene, pose(device), CAMERA)[0]
    strided = [t.repeat_interleave(2, 0)[::2] for t in scene]
    assert torch.equal(render(*strided, pose(device).T.contiguous().T, CAMERA)[0], first)


def test_parts_of_one_tensor_begin_anywhere(device):
    """Kernels read 16 bytes at a time: what does not lie so is copied, and gets its gradient all the same."""
    scene = on(device, make_scene(10), grad=False)
    flat = torch.cat([torch.zeros(1, device=device), *(t.flatten() for t in scene)]).requires_grad_()
    sizes = [1, *(t.numel() for t in scene)]
    parts = [p.view_as(t) for p, t in zip(flat.split(sizes)[1:], scene, strict=True)]
    assert any(p.data_ptr() % 16 for p in parts)
    whole = [t.requires_grad_() for t in scene]
    images = [render(*tensors, pose(device), CAMERA)[0] for tensors in (parts, whole)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    assert torch.equal(flat.grad[1:], torch.cat([t.grad.flatten() for t in whole]))


def test_is_deterministic(device):
    def once():
        scene = on(device, make_scene(60))
        tau = torch.zeros(6, device=device, requires_grad=True)
        render(*scene, pose(device), CAMERA, tau=tau)[0].square().sum().backward()
        return [t.grad for t in (*scene, tau)]

    for a, b in zip(once(), once(), strict=True):
        assert torch.equal(a, b)


def test_a_gaussian_larger_than_the_screen_needs_more_slots(device):
    camera = Camera(200, 160, 150.0, 150.0, 99.5, 79.5)
    scene = make_scene(3)
    scene[2][:] = np.log(5.0)
    scene[3][:] = -3.0
    image, transmittance, _ = render(*(t.to(device).float() for t in scene), pose(device), camera)
    expected = oracle.render(*scene, pose("cpu", torch.float64), camera)
    assert relative(image, expected[0]) < 1e-4
    assert relative(transmittance, expected[1]) < 1e-4


def test_nothing_to_see_is_black(device):
    scene = on(device, make_scene(5))
    behind = torch.tensor(np.diag([-1.0, 1, -1, 1]) @ T_CW, dtype=torch.float32, device=device)
    for inputs, T in ((scene, behind), (on(device, [t[:0] for t in make_scene(1)]), pose(device))):
        tau = torch.zeros(6, device=device, requires_grad=True)
        image, transmittance, median_depth = render(*inputs, T, CAMERA, tau=tau)
        assert not image.any() and not median_depth.any() and (transmittance == 1).all()
        (image.sum() + transmittance.sum()).backward()
        assert not tau.grad.any()
        assert all(t.grad is not None and not t.grad.any() for t in inputs)


def test_faulty_gaussians_do_not_spoil_the_picture(device):
    sound = make_scene(12)
    faulty = [t.clone() for t in make_scene(5, seed=9)]
    for k in range(5):
        faulty[k][k] = float("nan")
    mixed = on(device, [torch.cat(pair) for pair in zip(faulty, sound, strict=True)])
    image, _, _ = render(*mixed, pose(device), CAMERA)
    expected, _, _ = render(*on(device, sound, grad=False), pose(device), CAMERA)
    assert torch.equal(image, expected)
    image.square().sum().backward()
    for tensor in mixed:
        assert tensor.grad.isfinite().all() and not tensor.grad[:5].any() and tensor.grad[5:].any()


@settings(max_examples=10)
@given(n=st.integers(0, 12), width=st.integers(1, 40), height=st.integers(1, 40), seed=st.integers(0, 99))
def test_any_size(n, width, height, seed):
    camera = Camera(width, height, 20.0, 25.0, width / 3, height / 2)
    scene = make_scene(n, seed=seed)
    actual = render(*(t.float() for t in scene), pose("cpu"), camera)
    expected = oracle.render(*scene, pose("cpu", torch.float64), camera)
    for a, e in zip(actual[:2], expected, strict=False):
        torch.testing.assert_close(a.double(), e, atol=5e-3, rtol=1e-3)


def test_wrong_arguments_are_named(device):
    scene = on(device, make_scene(4), grad=False)
    T = pose(device)
    with pytest.raises(ValueError, match=r"quats: torch\.float32 \[3, 4\]"):
        render(scene[0], scene[1][:3], *scene[2:], T, CAMERA)
    with pytest.raises(ValueError, match=r"means: torch\.float64"):
        render(scene[0].double(), *scene[1:], T, CAMERA)
    with pytest.raises(ValueError, match="pass tau"):
        render(*scene, T.requires_grad_(), CAMERA)
    with pytest.raises(ValueError, match="tau is not zero"):
        render(*scene, pose(device), CAMERA, tau=torch.ones(6, device=device))


def test_the_oracle_moves_the_camera_as_lie_does():
    tau = np.array([0.3, -0.2, 0.5, 0.7, -0.4, 1.1])
    np.testing.assert_allclose(oracle.se3_exp(torch.tensor(tau)).numpy(), se3.se3_exp(tau), atol=1e-12)
