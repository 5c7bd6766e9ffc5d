# SPDX-License-Identifier: Apache-2.0
"""Points to pixels and back."""

import numpy as np
import pytest

from ggwarp.geometry.camera import NEAR, Camera

CAMERA = Camera(64, 48, 50.0, 60.0, 31.0, 24.5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_pixels_come_back(rng: np.random.Generator, dtype: type) -> None:
    pixels = rng.uniform(-20, 90, (7, 5, 2)).astype(dtype)
    depth = rng.uniform(NEAR + 0.01, 9.0, (7, 5)).astype(dtype)
    points = CAMERA.back_project(pixels[..., 0], pixels[..., 1], depth)
    again, front = CAMERA.project(points)
    assert points.shape == (7, 5, 3) and points.dtype == again.dtype == dtype and front.all()
    np.testing.assert_array_equal(points[..., 2], depth)
    np.testing.assert_allclose(again, pixels, atol=1e-3 if dtype is np.float32 else 1e-10)


def test_projection_is_that_of_the_matrix(rng: np.random.Generator) -> None:
    points = rng.uniform([-1, -1, 0.5], [1, 1, 3], (20, 3))
    homogeneous = points @ CAMERA.matrix.T
    np.testing.assert_allclose(CAMERA.project(points)[0], homogeneous[:, :2] / homogeneous[:, 2:])


def test_what_is_near_or_behind_is_not_in_the_picture() -> None:
    points = np.array([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 0.0], [0, 0, NEAR], [0, 0, 2 * NEAR]])
    pixels, front = CAMERA.project(points)
    assert front.tolist() == [True, False, False, False, True] and np.isfinite(pixels).all()
    rows, columns, inside = CAMERA.pixels_of(points)
    assert inside.tolist() == front.tolist()
    assert rows.tolist() == [24, 0, 0, 0, 24] and columns.tolist() == [31, 0, 0, 0, 31]


def test_a_pixel_reaches_half_way_to_its_neighbours() -> None:
    u = np.array([-0.6, -0.4, 0.4, 63.4, 63.6])
    rows, columns, inside = CAMERA.pixels_of(CAMERA.back_project(u, np.full(5, 3.0), np.full(5, 2.0)))
    assert inside.tolist() == [False, True, True, True, False]
    assert rows[inside].tolist() == [3, 3, 3] and columns[inside].tolist() == [0, 0, 63]


def test_rays_are_broadcast() -> None:
    rays = CAMERA.rays(np.arange(4), np.arange(3)[:, None])
    assert rays.shape == (3, 4, 3) and (rays[..., 2] == 1.0).all()
    np.testing.assert_allclose(rays[2, 1], [(1 - 31.0) / 50.0, (2 - 24.5) / 60.0, 1.0])


def test_no_points_no_pixels() -> None:
    nothing = np.zeros((0, 3), np.float32)
    pixels, front = CAMERA.project(nothing)
    assert pixels.shape == (0, 2) and front.shape == (0,)
    assert [a.shape for a in CAMERA.pixels_of(nothing)] == [(0,)] * 3
    assert CAMERA.back_project(front, front, np.zeros(0)).shape == (0, 3)
