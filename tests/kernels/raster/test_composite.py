# SPDX-License-Identifier: Apache-2.0
"""Compositing and its adjoint against the float64 oracle, and what must hold on odd scenes."""

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from composite_scenes import NAMES, Composited, assert_same_direction, make_scene, oracle, random_gradients
from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.sampling import Sample
from ggwarp.kernels.raster.tiles import tiles_across
from ggwarp.ops.reference.render import composite as composite_reference


@pytest.mark.parametrize("channels", [4, 20])
def test_forward_matches_the_oracle(device, rng, channels):
    scene, size = make_scene(rng, channels=channels)
    for ours, theirs in zip(Composited(scene, size, device).planes(), oracle(scene, size), strict=True):
        assert np.abs(ours - theirs).max() < 2e-5


@pytest.mark.parametrize("channels", [4, 20])
def test_adjoint_matches_the_oracle(device, rng, channels):
    scene, size = make_scene(rng, channels=channels)
    seeds = random_gradients(rng, channels, size)
    ours = Composited(scene, size, device).adjoint(*seeds)
    _, theirs = oracle(scene, size, *seeds)
    for mine, reference_gradient in zip(ours, theirs, strict=True):
        assert_same_direction(mine, reference_gradient)
    assert_same_direction(ours[1][:, 3], theirs[1][:, 3])


@pytest.mark.parametrize("channels", [4, 20])
def test_weights_are_the_pixels_that_a_splat_makes_up(device, rng, channels):
    scene, size = make_scene(rng, channels=channels)
    run = Composited(scene, size, device)
    run.adjoint(*random_gradients(rng, channels, size))
    padded = [16 * tiles_across(side) for side in size]
    ones = np.zeros((channels, *padded[::-1]))
    ones[0] = 1.0
    planes, theirs = oracle(scene, padded, ones, np.zeros(padded[::-1]))
    assert_same_direction(run.weights, theirs[3][:, 0])
    np.testing.assert_allclose(run.weights.sum(), (1.0 - planes[1]).sum(), rtol=1e-4)


def run_all(scene, size, device, seeds, *, identity_shapes=True, **options):
    """Planes and gradients, as one list of arrays."""
    run = Composited(scene, size, device, **options)
    return [*run.planes(), *run.adjoint(*seeds, identity_shapes=identity_shapes)]


def test_adjoint_matches_finite_differences(device, rng):
    """On wide, faint splats, away from thresholds and clamps: where the image is smooth."""
    scene, size = make_scene(rng, n=8, width=16, height=16, channels=4, sigma=(12, 30), opacity=(0.3, 0.5))
    seeds = random_gradients(rng, 4, size)
    gradients = Composited(scene, size, device).adjoint(*seeds)

    def loss(values):
        image, transmittance, _ = Composited(values, size, device, everywhere=True).planes()
        return (image * seeds[0].astype(np.float64)).sum() + (
            transmittance * seeds[1].astype(np.float64)
        ).sum()

    for name, gradient, step in zip(NAMES, gradients, (0.5, 3e-5, 0.05, 0.5), strict=True):
        numeric = np.zeros_like(gradient)
        for index in np.ndindex(*gradient.shape):
            h = 1e-2 if name == "conics" and index[1] == 3 else step
            shifted = []
            for sign in (h, -h):
                values = {k: v.copy() for k, v in scene.items()}
                values[name][index] += np.float32(sign)
                shifted.append((loss(values), float(values[name][index])))
            numeric[index] = (shifted[0][0] - shifted[1][0]) / (shifted[0][1] - shifted[1][1])
        assert_same_direction(gradient, numeric, tolerance=2e-2)


def detached_oracle(scene, size, d_image, d_transmittance):
    """The oracle's gradients where the identity is blended by weights that take no gradient."""
    tensors = {k: torch.from_numpy(v).double().requires_grad_(k != "depths") for k, v in scene.items()}
    fixed = {k: v.detach() for k, v in tensors.items()} | {"features": tensors["features"]}
    planes = composite_reference(**tensors, width=size[0], height=size[1])
    identity = composite_reference(**fixed, width=size[0], height=size[1])[0][4:]
    loss = (torch.cat([planes[0][:4], identity]) * torch.from_numpy(d_image)).sum()
    loss = loss + (planes[1] * torch.from_numpy(d_transmittance)).sum()
    return [g.numpy() for g in torch.autograd.grad(loss, [tensors[k] for k in NAMES])]


def test_the_identity_may_be_kept_from_shaping(device, rng):
    scene, size = make_scene(rng)
    seeds = random_gradients(rng, 20, size)
    run = Composited(scene, size, device)
    ours = run.adjoint(*seeds, identity_shapes=False)
    for mine, reference_gradient in zip(ours, detached_oracle(scene, size, *seeds), strict=True):
        assert_same_direction(mine, reference_gradient)
    assert np.array_equal(ours[3], run.adjoint(*seeds)[3])


@pytest.fixture
def cpu_blocks():
    """Lets a CPU run cooperative kernels, as a GPU does."""
    before = wp.config.enable_cpu_blocks
    wp.config.enable_cpu_blocks = True
    yield
    wp.config.enable_cpu_blocks = before


@pytest.mark.parametrize(("channels", "identity_shapes"), [(4, True), (20, True), (20, False)])
def test_cuda_form_agrees_with_cpu_form(rng, cpu_blocks, channels, identity_shapes):
    scene, size = make_scene(rng, n=300, width=36, height=20, channels=channels, opacity=(0.05, 1.0))
    seeds = random_gradients(rng, channels, size)
    ours, theirs = (
        run_all(
            scene,
            size,
            "cpu",
            seeds,
            everywhere=True,
            cooperative=form,
            identity_shapes=identity_shapes,
        )
        for form in (True, False)
    )
    for a, b in zip(ours[:3], theirs[:3], strict=True):
        assert np.abs(a - b).max() < 2e-5
    for a, b in zip(ours[3:], theirs[3:], strict=True):
        assert_same_direction(a, b, tolerance=1e-4)


@pytest.mark.parametrize("cooperative", [False, True], ids=["CPU form", "CUDA form"])
@pytest.mark.parametrize(("stride", "phase"), [(8, 0), (8, 5), (3, 1), (8, -1)])
def test_identities_are_blended_in_the_sample_alone(rng, cpu_blocks, stride, phase, cooperative):
    scene, size = make_scene(rng, n=200, width=52, height=40)
    d_image, d_transmittance = random_gradients(rng, 20, size)
    y, x = np.mgrid[: size[1], : size[0]]
    looked_at = (x // 16 - 2 * (y // 16)) % stride == phase
    seen = d_image.copy()
    seen[4:] *= looked_at

    sample = Sample(stride, wp.full(1, phase, dtype=int, device="cpu"))
    ours = Composited(scene, size, "cpu", cooperative=cooperative, sample=sample)
    whole = Composited(scene, size, "cpu")

    image, all_of_it = ours.planes()[0], whole.planes()[0]
    assert looked_at.any() == (phase >= 0)
    np.testing.assert_allclose(image[:4], all_of_it[:4], atol=2e-5)
    np.testing.assert_allclose(image[4:, looked_at], all_of_it[4:, looked_at], atol=2e-5)
    assert (image[4:, ~looked_at] == 7.0).all()
    # What d_image says elsewhere counts for nothing.
    gradients = ours.adjoint(d_image, d_transmittance)
    for mine, theirs in zip(gradients, whole.adjoint(seen, d_transmittance), strict=True):
        assert_same_direction(mine, theirs, tolerance=1e-4)
    assert gradients[3][:, 4:].any() == (phase >= 0)


def test_thread_count_does_not_change_a_bit(rng, assert_same_on_any_threads):
    scene, size = make_scene(rng, n=200, width=100, height=90)
    seeds = random_gradients(rng, 20, size)
    assert_same_on_any_threads(lambda: run_all(scene, size, "cpu", seeds))


def test_no_splats_leave_black(device):
    scene, size = make_scene(np.random.default_rng(0), n=1, width=20, height=40, channels=4)
    scene["means2d"][:] = 1e6
    run = Composited(scene, size, device)
    image, transmittance, median = run.planes()
    assert run.slots == 0 and not image.any() and not median.any() and (transmittance == 1).all()
    assert not any(g.any() for g in run.adjoint(np.ones_like(image), np.ones_like(transmittance)))


def test_one_splat_is_its_formula(device):
    scene = {
        "means2d": np.array([[17.25, 9.5]], np.float32),
        "conics": np.array([[0.2, 0.05, 0.1, 0.8]], np.float32),
        "slopes": np.array([[0.25, -0.125]], np.float32),
        "depths": np.array([2.5], np.float32),
        "features": np.array([[0.5, 1.0, 2.0, 2.5]], np.float32),
    }
    image, transmittance, median = Composited(scene, (40, 24), device).planes()
    dy, dx = np.mgrid[:24, :40] - np.array([9.5, 17.25])[:, None, None]
    alpha = 0.8 * np.exp(-0.5 * (0.2 * dx**2 + 0.1 * dy**2) - 0.05 * dx * dy)
    alpha[alpha < 1 / 255] = 0
    assert np.abs(transmittance - (1 - alpha)).max() < 2e-6
    assert np.abs(image[:3] - scene["features"][0][:3, None, None] * alpha).max() < 5e-6
    depth = 2.5 + 0.25 * dx - 0.125 * dy
    assert np.abs(image[3] - depth * alpha).max() < 1e-5
    assert np.abs(median - np.where(alpha > 0.5, depth, 0.0)).max() < 1e-5


@pytest.mark.parametrize("cooperative", [False, True], ids=["CPU form", "CUDA form"])
def test_needles_at_every_angle_lose_nothing(rng, cpu_blocks, cooperative):
    """A splat is looked for wherever alpha reaches 1/255, however thin and long it is."""
    scene, size = make_scene(rng, n=150, width=70, height=50, channels=4)
    angle = np.linspace(0, np.pi, 150)
    c, s = np.cos(angle), np.sin(angle)
    long, thin = np.exp(rng.uniform(*np.log((4.0, 300.0)), 150)) ** -2.0, 0.56**-2.0
    a, b, d = c * c * long + s * s * thin, c * s * (long - thin), s * s * long + c * c * thin
    scene["conics"][:, :3] = np.stack([a, b, d], -1)
    scene["conics"][:, 3] = rng.uniform(0.004, 0.1, 150)
    ours = Composited(scene, size, "cpu", cooperative=cooperative).planes()[:2]
    for mine, theirs in zip(ours, oracle(scene, size)[:2], strict=True):
        assert np.abs(mine - theirs).max() < 3e-4, (
            "one that is lost is 4e-3 of its colour, less what hides it"
        )


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_extreme_opacities(device, rng, opacity):
    scene, size = make_scene(rng, opacity=(opacity, opacity))
    seeds = random_gradients(rng, 20, size)
    run = Composited(scene, size, device, everywhere=True)
    gradients = run.adjoint(*seeds)
    values, theirs = oracle(scene, size, *seeds)
    for mine, reference_plane in zip(run.planes(), values, strict=True):
        assert np.abs(mine - reference_plane).max() < 2e-5
    for mine, reference_gradient in zip(gradients, theirs, strict=True):
        if opacity:
            assert_same_direction(mine, reference_gradient)
        else:
            assert not mine.any()


def test_nan_stays_in_its_tiles(device, rng):
    scene, size = make_scene(rng, n=40, width=64, height=64, channels=4, sigma=(0.6, 2.0))
    scene["means2d"][0] = (8, 8)
    scene["conics"][0] = (1, 0, 1, 0.5)
    scene["features"][0] = np.nan
    scene["conics"][1, 0] = np.nan
    scene["means2d"][1] = (8, 8)
    run = Composited(scene, size, device, everywhere=False)
    image, transmittance, _ = run.planes()
    assert np.isnan(image[:, 8, 8]).all() and np.isfinite(transmittance).all()
    assert np.isfinite(image[:, 16:]).all() and np.isfinite(image[:, :, 16:]).all()


@pytest.mark.parametrize("cooperative", [None, True], ids=["own form", "CUDA form"])
def test_splats_behind_an_opaque_wall_get_nothing(device, rng, cpu_blocks, cooperative):
    """More splats than any chunk or block; the wall ends every pixel, so what follows is never reached."""
    scene, size = make_scene(rng, n=700, width=16, height=16, channels=4, sigma=(2, 4))
    wall = np.argsort(scene["depths"])[:40]
    scene["conics"][wall] = (1e-6, 0, 1e-6, 0.9)
    seeds = random_gradients(rng, 4, size)
    run = Composited(scene, size, device, everywhere=True, cooperative=cooperative)
    assert run.slots == 700 and (run.planes()[1] < 1e-4).all()
    gradients = run.adjoint(*seeds)
    _, theirs = oracle(scene, size, *seeds)
    assert not gradients[3][np.argsort(scene["depths"])[40:]].any()
    assert_same_direction(gradients[3], theirs[3])


@pytest.mark.parametrize("spread", [(0.3, 1.0), (8.0, 40.0)], ids=["small", "large"])
def test_cuda_form_matches_the_oracle_where_few_or_all_warps_see_a_splat(rng, cpu_blocks, spread):
    scene, size = make_scene(rng, n=400, width=40, height=24, sigma=spread, opacity=(0.02, 0.2))
    seeds = random_gradients(rng, 20, size)
    run = Composited(scene, size, "cpu", cooperative=True)
    values, theirs = oracle(scene, size, *seeds)
    for mine, reference_plane in zip(run.planes()[:2], values, strict=False):
        assert np.abs(mine - reference_plane).max() < 5e-5
    for mine, reference_gradient in zip(run.adjoint(*seeds), theirs, strict=True):
        assert_same_direction(mine, reference_gradient, tolerance=5e-4)


@settings(max_examples=15)
@given(n=st.integers(1, 90), width=st.integers(1, 50), height=st.integers(1, 50), seed=st.integers(0, 2**31))
def test_any_size_matches_the_oracle(n, width, height, seed):
    rng = np.random.default_rng(seed)
    scene, size = make_scene(rng, n=n, width=width, height=height, channels=4, sigma=(0.3, 12.0))
    for ours, theirs in zip(
        Composited(scene, size, "cpu").planes()[:2], oracle(scene, size)[:2], strict=True
    ):
        # A contribution at the threshold may fall on either side of it.
        assert np.abs(ours - theirs).max() < 5e-3 and np.abs(ours - theirs).mean() < 1e-5


def test_misfits_are_named(device, rng):
    scene, size = make_scene(rng, n=3, channels=4)
    run = Composited(scene, size, device)
    run.identities = wp.zeros(3, dtype=vec16, device=device)
    with pytest.raises(ValueError, match="needed"):
        run.forward()
