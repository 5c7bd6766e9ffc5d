# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.geometry.boxes import Extents, axis_aligned_box, main_parts, oriented_box, separate_parts

SIZES = np.array([1.2, 0.5, 0.3])


def _surface(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    """Points on the faces of a box of ``SIZES`` about the origin, as a map's Gaussians lie."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return points * SIZES


def test_a_turned_box_is_found_again(rng):
    for _ in range(5):
        R = se3.so3_exp(rng.normal(size=3))
        box = oriented_box(_surface(rng) @ R.T + [1.0, 2.0, 3.0])
        np.testing.assert_allclose(2.0 * np.array(box.half_sizes), SIZES, rtol=0.06)
        np.testing.assert_allclose(box.centre, [1.0, 2.0, 3.0], atol=0.02)
        np.testing.assert_allclose(np.abs(np.diag(R.T @ box.axes)), 1.0, atol=0.01)
        assert np.linalg.det(box.axes) == pytest.approx(1.0)


def test_half_a_box_still_gives_its_directions(rng):
    """What a camera sees of a box: three faces. Principal axes would lean by tens of degrees."""
    points = _surface(rng)
    near = points[(points >= 0.499 * SIZES).any(axis=1)]
    R = se3.so3_exp([0.3, -0.4, 0.6])
    box = oriented_box(near @ R.T)
    np.testing.assert_allclose(np.abs(np.diag(R.T @ box.axes)), 1.0, atol=0.01)


@pytest.mark.parametrize("count", [1, 2, 3, 50])
@pytest.mark.parametrize("spread", [[0, 0, 0], [1, 0, 0], [1, 1, 0]])
def test_points_without_volume_have_a_box(rng, count, spread):
    points = rng.uniform(size=(count, 3)) * spread + 4.0
    box = oriented_box(points)
    assert np.isfinite([*box.centre, *box.quat, *box.half_sizes]).all()
    assert list(box.half_sizes) == sorted(box.half_sizes, reverse=True)
    local = (points - box.centre) @ box.axes
    assert (np.abs(local) <= 1.1 * np.array(box.half_sizes) + 0.02).all()


def test_the_same_points_in_another_order_give_the_same_box(rng):
    points = _surface(rng, 500)
    one, other = oriented_box(points), oriented_box(points[rng.permutation(500)])
    np.testing.assert_allclose(one.quat, other.quat, atol=1e-9)


def test_strays_are_no_part(rng):
    body = rng.uniform(0, 1, (300, 3))
    leg = rng.uniform(0, 0.2, (40, 3)) + np.array([2.0, 0.0, 0.0])
    strays = rng.uniform(5, 50, (6, 3))
    kept = main_parts(np.concatenate([body, leg, strays]))
    assert kept[:340].mean() > 0.98 and not kept[340:].any()
    assert main_parts(np.zeros((2, 3))).all() and main_parts(np.zeros((50, 3))).all()
    assert len(main_parts(np.zeros((0, 3)))) == 0


def test_a_few_points_far_off_are_no_part_and_many_are(rng):
    mouse = rng.uniform(0, 0.1, (13, 3))
    strays = rng.uniform(0, 0.02, (3, 3)) + np.array([0.8, 0.0, 0.0])
    kept = main_parts(np.concatenate([mouse, strays]))
    assert kept[:13].sum() >= 10 and not kept[13:].any()
    assert max(oriented_box(np.concatenate([mouse, strays])[kept]).half_sizes) < 0.1
    other_half = rng.uniform(0, 0.1, (40, 3)) + np.array([5.0, 0.0, 0.0])
    parts = separate_parts(np.concatenate([rng.uniform(0, 0.1, (60, 3)), other_half]))
    assert (parts[:60] == 0).mean() > 0.9 and (parts[60:] == 1).mean() > 0.9


def test_the_upright_box_is_trimmed(rng):
    points = rng.uniform(0, 1, (1000, 3))
    points[0] = -7.0
    box = axis_aligned_box(points)
    assert min(box.low) >= 0.0 and max(box.high) <= 1.0


def _turned(rng, n, R):
    """Quaternions [n, 4] of ``R`` times nothing, and sizes and opacities of as many Gaussians."""
    quats = np.tile(se3.quat_from_matrix(R), (n, 1)).astype(np.float32) * rng.uniform(0.5, 2.0, (n, 1))
    log_scales = np.log(np.tile([0.04, 0.02, 0.01], (n, 1))).astype(np.float32)
    return quats, log_scales


def test_extents_are_the_ellipsoids(rng):
    """Along any direction d the variance is d^T S d, and half the opacity is left where the box ends."""
    R = se3.so3_exp([0.4, -0.2, 0.9])
    quats, log_scales = _turned(rng, 3, R)
    extents = Extents.of(quats, log_scales, np.log(np.float32([0.95 / 0.05, 0.6 / 0.4, 0.3 / 0.7])))
    axes = se3.so3_exp([0.1, 0.7, -0.3])
    covariance = R @ np.diag([0.04, 0.02, 0.01]) ** 2 @ R.T
    expected = np.sqrt(np.diag(axes.T @ covariance @ axes))
    np.testing.assert_allclose(extents.along(axes), np.tile(expected, (3, 1)), rtol=1e-5)
    alphas = np.array([0.95, 0.6, 0.3]) * np.exp(-0.5 * extents.reaches**2)
    np.testing.assert_allclose(alphas, [0.5, 0.5, 0.3], rtol=1e-6)


def test_a_box_ends_where_its_gaussians_become_half_transparent(rng):
    R = se3.so3_exp([0.3, -0.4, 0.6])
    n = 4000
    points = (_surface(rng, n) * (SIZES - 0.06) / SIZES) @ R.T
    sigma = 0.03 / np.sqrt(2.0 * np.log(2.0 * 0.9))
    round_ones = np.full((n, 3), np.log(sigma), np.float32)
    extents = Extents.of(_turned(rng, n, R)[0], round_ones, np.full(n, np.log(0.9 / 0.1), np.float32))
    box = oriented_box(points, extents)
    np.testing.assert_allclose(2.0 * np.array(box.half_sizes), SIZES, atol=0.02)
    np.testing.assert_allclose(box.sigmas, np.sqrt(2.0) * sigma, rtol=1e-4)
    upright = axis_aligned_box(points @ R, extents)
    np.testing.assert_allclose(np.subtract(upright.high, upright.low), SIZES, atol=0.02)
    assert oriented_box(points).sigmas is None
    clear = Extents.of(_turned(rng, n, R)[0], round_ones, np.full(n, -1.0, np.float32))
    np.testing.assert_allclose(oriented_box(points, clear).half_sizes, oriented_box(points).half_sizes)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_gaussians_have_a_box_and_its_uncertainty(rng, count):
    quats, log_scales = _turned(rng, count, np.eye(3))
    quats[0] = 0.0
    box = oriented_box(rng.uniform(size=(count, 3)), Extents.of(quats, log_scales, np.full(count, 2.0)))
    assert np.isfinite([*box.centre, *box.quat, *box.half_sizes, *box.sigmas]).all()
    assert min(box.sigmas) >= 0.0
