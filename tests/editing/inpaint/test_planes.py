# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ggwarp.editing.inpaint.planes import Plane, fit_planes, surface_normals
from ggwarp.geometry import se3
from ggwarp.map.gaussians import Gaussians

TOWARDS = np.array([0.0, 0.0, 1.0])


def _patch(rng, count, axes, origin, noise=0.002):
    flat = rng.uniform(-0.5, 0.5, (count, 2))
    points = origin + flat @ axes[:, :2].T + rng.normal(0, noise, (count, 1)) * axes[:, 2]
    normals = axes[:, 2] * rng.choice([-1.0, 1.0], (count, 1)) + rng.normal(0, 0.05, (count, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _fit(points, normals, **options):
    values = {"reach": 0.01, "least": 20, "most": 5, "towards": TOWARDS} | options
    return fit_planes(points, normals, np.ones(len(points)), **values)


def test_planes_are_found_among_noise(rng):
    one, two = se3.so3_exp([0.2, 0.1, 0.0]), se3.so3_exp([1.5, 0.3, 0.4])
    parts = [_patch(rng, 300, one, [0, 0, -1]), _patch(rng, 150, two, [0.3, 0, -0.8])]
    parts.append((rng.uniform(-1, 1, (80, 3)), rng.normal(size=(80, 3))))
    points, normals = (np.concatenate(p) for p in zip(*parts, strict=True))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = _fit(points, normals)
    assert len(found) == 2
    for (plane, own), axes, span in zip(found, (one, two), ((0, 300), (300, 450)), strict=True):
        assert abs(plane.normal @ axes[:, 2]) > 0.999
        assert own[slice(*span)].mean() > 0.8
        assert (TOWARDS - plane.origin) @ plane.normal > 0.0


def test_a_rough_surface_is_one_plane(rng):
    points, normals = _patch(rng, 800, np.eye(3), [0, 0, -1], noise=0.012)
    assert len(_fit(points, normals)) == 1


def test_the_surface_decides_not_the_points_alone(rng):
    """Points of a plane whose normals lie in it are no surface there."""
    points, _ = _patch(rng, 200, np.eye(3), [0, 0, -1])
    assert _fit(points, np.tile([1.0, 0.0, 0.0], (200, 1)), least=150) == []


@pytest.mark.parametrize("count", [0, 1, 2, 19])
def test_too_few_points(rng, count):
    points, normals = _patch(rng, count, np.eye(3), [0, 0, -1])
    assert _fit(points, normals) == []


def test_coordinates(rng):
    plane = Plane(rng.normal(size=3), se3.so3_exp(rng.normal(size=3)))
    flat = rng.normal(size=(10, 2))
    points = plane.points(flat)
    np.testing.assert_allclose(plane.coordinates(points), np.insert(flat, 2, 0.0, axis=1), atol=1e-12)
    centre = plane.origin + 2.0 * plane.normal + plane.axes[:, 0]
    rays = points - centre
    np.testing.assert_allclose(plane.depths(3.0 * rays, centre), 1.0 / 3.0, rtol=1e-9)
    assert (
        np.isinf(plane.depths(-rays, centre)).all()
        and np.isinf(plane.depths(plane.axes[:, :2].T, centre)).all()
    )


def test_a_gaussian_is_thinnest_along_its_normal(rng):
    n = 50
    R = Rotation.random(n, random_state=3)
    thin = rng.integers(0, 3, n)
    scales = np.zeros((n, 3), np.float32)
    scales[np.arange(n), thin] = -2.0
    zeros = np.zeros((n, 3), np.float32)
    quats = R.as_quat()[:, [3, 0, 1, 2]].astype(np.float32)
    normals = surface_normals(Gaussians(zeros, quats, scales, zeros[:, 0], zeros))
    np.testing.assert_allclose(normals, R.as_matrix()[np.arange(n), :, thin], atol=1e-5)
