# SPDX-License-Identifier: Apache-2.0
"""From depth to points: how noisy a frame is, by its normals, and what that leaves of them."""

from collections.abc import Callable

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.tracking.preprocess import ObservationConfig, observe, sample_points
from ggwarp.runtime.scratch import ScratchArrays

CAMERA = Camera(320, 240, 280.0, 280.0, 159.5, 119.5)
CONFIG = ObservationConfig()


def planes(noise: float, rng: np.random.Generator) -> np.ndarray:
    """Two slanted planes with an edge between them, [h, w] metres; ``noise`` is a share of the model's."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    depth = 1.0 / (0.4 + 0.0003 * u + 0.0002 * v)
    depth[:, 170:] += 0.5
    depth += noise * (0.001 + 0.002 * depth**2) * rng.normal(size=depth.shape)
    return depth.astype(np.float32)


@settings(max_examples=20)
@given(h=st.integers(1, 30), w=st.integers(1, 30), stride=st.integers(1, 12), seed=st.integers(0, 999))
def test_points_are_the_back_projected_grid(h: int, w: int, stride: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.05, 11.0, (h, w)).astype(np.float32)
    depth[rng.random((h, w)) < 0.2] = 0.0
    camera = Camera(w, h, 50.0, 60.0, 15.5, 11.25)
    points, pixels = sample_points(depth, camera, stride, near=0.1, far=10.0)
    v, u = np.mgrid[stride // 2 : h : stride, stride // 2 : w : stride]
    z = depth[v, u].astype(np.float64)
    keep = (z >= 0.1) & (z <= 10.0)
    u, v, z = u[keep], v[keep], z[keep]
    np.testing.assert_array_equal(pixels, np.stack([u, v], 1))
    np.testing.assert_allclose(
        points, np.stack([(u - 15.5) * z / 50.0, (v - 11.25) * z / 60.0, z], 1), rtol=1e-5
    )


def test_what_is_not_a_reading_gives_no_point() -> None:
    depth = np.array([[0.0, np.nan, np.inf], [-1.0, 0.05, 10.5], [1.0, 9.9, 0.1]], np.float32)
    _, pixels = sample_points(depth, Camera(3, 3, 50.0, 50.0, 1.0, 1.0), 1, near=0.1, far=10.0)
    np.testing.assert_array_equal(pixels, [[0, 2], [1, 2], [2, 2]])


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_an_empty_image(shape: tuple[int, int], device: str) -> None:
    camera = Camera(shape[1], shape[0], 50.0, 50.0, 1.0, 1.0)
    assert observe(np.zeros(shape, np.float32), camera, CONFIG, device=device).count == 0


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_noise_is_measured_in_the_frame(noise: float, device: str, rng: np.random.Generator) -> None:
    seen = observe(planes(noise, rng), CAMERA, CONFIG, device=device)
    assert seen.noise_share == pytest.approx(noise, rel=0.2, abs=0.02)


@pytest.mark.parametrize("depth", [np.zeros((240, 320)), np.eye(240, 320)], ids=["nothing", "a line"])
def test_where_little_is_seen_there_is_no_noise(depth: np.ndarray, device: str) -> None:
    assert observe(depth.astype(np.float32), CAMERA, CONFIG, device=device).noise_share == 0.0


def test_noisy_points_are_held_along_their_surface(device: str, rng: np.random.Generator) -> None:
    clean, noisy = (observe(planes(n, rng), CAMERA, CONFIG, device=device) for n in (0.0, 1.0))
    along = [np.median(seen.spreads.numpy()[:, 0]) for seen in (clean, noisy)]
    extent = np.median(noisy.scales.numpy()[:, 0])
    assert along[0] == 1.0, "free"
    # A plane through ten readings is known to a tilt of noise / (sqrt(10) extent).
    assert 2.0 * extent < along[1] < 6.0 * extent
    assert (noisy.spreads.numpy()[:, :2] >= noisy.spreads.numpy()[:, 2:]).all(), "no needles"


def test_what_counts_less_is_as_uncertain(device: str) -> None:
    depth = planes(0.0, np.random.default_rng(0))
    weights = np.ones(depth.shape, np.float32)
    weights[:120], weights[120:140] = 0.25, 0.0
    plain = observe(depth, CAMERA, CONFIG, device=device)
    seen = observe(depth, CAMERA, CONFIG, weights=weights, device=device)
    v = seen.pixels.numpy()[:, 1]
    np.testing.assert_allclose(seen.noise[v < 120], 2.0 * plain.noise[v < 120], rtol=1e-6)
    np.testing.assert_array_equal(seen.noise[v >= 140], plain.noise[v >= 140])
    assert np.isfinite(seen.noise).all() and (seen.spreads.numpy()[:, 2] >= seen.noise * 0.999).all()


def test_kept_arrays_hold_what_new_ones_would(device: str, rng: np.random.Generator) -> None:
    scratch = ScratchArrays(device)
    for noise in (0.0, 1.0, 0.3):
        depth = planes(noise, rng)
        depth[rng.random(depth.shape) < 0.3 * noise] = 0.0
        fresh = observe(depth, CAMERA, CONFIG, device=device)
        kept = observe(depth, CAMERA, CONFIG, device=device, scratch=scratch)
        for name in ("quats", "scales", "pixels", "spreads"):
            np.testing.assert_array_equal(getattr(kept, name).numpy(), getattr(fresh, name).numpy())
        for name in ("points", "covariances"):
            np.testing.assert_array_equal(
                getattr(kept.cloud, name).numpy(), getattr(fresh.cloud, name).numpy()
            )


def test_a_second_frame_takes_no_memory(
    device: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On CUDA freeing an array is a barrier for both lanes."""
    scratch, taken = ScratchArrays(device), []
    observe(planes(1.0, rng), CAMERA, CONFIG, device=device, scratch=scratch)

    def counting(make: Callable) -> Callable:
        def counted(*args, **kwargs):
            # On CUDA what is read back needs memory of the host's.
            if device == "cpu" or kwargs.get("device") != "cpu":
                taken.append(args)
            return make(*args, **kwargs)

        return counted

    for name in ("empty", "zeros"):
        monkeypatch.setattr(wp, name, counting(getattr(wp, name)))
    observe(planes(1.0, rng), CAMERA, CONFIG, device=device, scratch=scratch)
    assert taken == []
    observe(planes(1.0, rng), CAMERA, CONFIG, device=device)
    assert len(taken) > 8
