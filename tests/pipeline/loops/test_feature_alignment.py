# SPDX-License-Identifier: Apache-2.0
"""The motion between matched features with depth, against truth and finite differences."""

import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.feature_alignment import FeatureAligner, kabsch

CAMERA = Camera(480, 360, 400.0, 400.0, 239.5, 179.5)
MOTION = se3.se3_exp([0.3, -0.1, 0.2, 0.1, 0.3, -0.5])


def noise(z):
    return 0.001 + 0.002 * z * z


def scene(rng, n):
    """Points in a first camera, their pixels there, and the same points in a second camera."""
    points = rng.uniform([-1.0, -0.8, 1.0], [1.0, 0.8, 4.0], (n, 3))
    return CAMERA.project(points)[0], points, se3.transform_points(se3.inverse(MOTION), points)


def aligned(pixels, a, b, seed=(3,)):
    return FeatureAligner(CAMERA, noise).align(pixels, a, b, seed=seed)


def test_exact_matches_give_the_exact_motion(rng):
    found = aligned(*scene(rng, 40))
    np.testing.assert_allclose(found.T_ab, MOTION, atol=1e-9)
    assert found.count == 40


def test_false_matches_are_left_out(rng):
    pixels, a, b = scene(rng, 100)
    wrong = np.arange(100) < 60
    b[wrong] = b[wrong][rng.permutation(60)]
    a = a + rng.normal(size=a.shape) * [0, 0, 1] * noise(a[:, 2:])
    pixels = pixels + rng.normal(size=pixels.shape)
    found = aligned(pixels, a, b)
    error = se3.se3_log(se3.inverse(MOTION) @ found.T_ab)
    assert np.abs(error[:3]).max() < 0.01 and np.abs(error[3:]).max() < 0.005
    assert found.inliers[~wrong].mean() > 0.9 and found.inliers[wrong].mean() < 0.1


def test_information_is_that_of_the_residuals(rng):
    """J^T J by central differences: at exact matches every weight is one."""
    pixels, a, b = scene(rng, 30)
    aligner = FeatureAligner(CAMERA, noise)
    found = aligner.align(pixels, a, b, seed=(1,))
    assert found is not None
    h, columns = 1e-6, []
    for k in range(6):
        ends = []
        for sign in (1.0, -1.0):
            T = found.T_ab @ se3.se3_exp(sign * h * np.eye(6)[k])
            moved = se3.transform_points(T, b)
            uv, _ = CAMERA.project(moved)
            depth = (moved[:, 2] - a[:, 2]) / (np.sqrt(2.0) * noise(a[:, 2]))
            ends.append(np.concatenate([((uv - pixels) / 1.5).ravel(), depth]))
        columns.append((ends[0] - ends[1]) / (2 * h))
    J = np.stack(columns, axis=1)
    np.testing.assert_allclose(found.information, 0.1 * J.T @ J, rtol=1e-4, atol=1e-3 * np.abs(J.T @ J).max())


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_matches_say_nothing(rng, n):
    assert aligned(*scene(rng, n)) is None


def test_matches_in_one_spot_end_without_a_fault(rng):
    pixels, a, b = scene(rng, 1)
    found = aligned(*(np.repeat(x, 5, axis=0) for x in (pixels, a, b)))
    assert found is None or np.isfinite(found.T_ab).all()


def test_the_same_seed_gives_the_same_bits(rng):
    data = scene(rng, 50)
    data[2][:25] += rng.normal(size=(25, 3))
    np.testing.assert_array_equal(aligned(*data).T_ab, aligned(*data).T_ab)


def test_kabsch_never_mirrors(rng):
    flat = rng.normal(size=(6, 3)) * [1, 1, 0]
    T = kabsch(se3.transform_points(MOTION, flat)[None], flat[None])[0]
    np.testing.assert_allclose(T, MOTION, atol=1e-9)
    mirrored = kabsch((flat * [1, 1, 1] + [0, 0, 1.0])[None], flat[None] * [-1, 1, 1])[0]
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1.0)
