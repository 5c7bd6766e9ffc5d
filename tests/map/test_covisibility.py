# SPDX-License-Identifier: Apache-2.0
"""Seen sets against a brute-force reading of the definition."""

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.map.covisibility import Covisibility, intersection_over_union, overlap_coefficient
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def wall(depth: float, step: float, opacity: float) -> Gaussians:
    x, y = np.meshgrid(np.arange(-0.4, 0.4, step), np.arange(-0.3, 0.3, step))
    means = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) * depth
    n = len(means)
    size = 0.8 * step * depth
    return Gaussians(
        means.astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.tile(np.log(np.array([size, size, 1e-3], np.float32)), (n, 1)),
        np.full(n, np.log(opacity / (1 - opacity)), np.float32),
        np.zeros((n, 3), np.float32),
    )


def test_what_an_opaque_wall_hides_is_not_seen(device: str) -> None:
    gaussians = GaussianMap(device=device, has_identity=False)
    front, back = wall(1.0, 0.02, 0.9), wall(2.0, 0.02, 0.9)
    gaussians.append(front)
    gaussians.append(back)

    sight = Covisibility(gaussians, CAMERA).look(np.eye(4))

    assert sight.seen[: len(front)].all()
    assert not sight.seen[len(front) :].any()
    assert abs(sight.median_depth - 1.0) < 0.01


def test_through_a_thin_wall_the_next_is_seen(device: str) -> None:
    gaussians = GaussianMap(device=device, has_identity=False)
    front, back = wall(1.0, 0.02, 0.02), wall(2.0, 0.02, 0.9)
    gaussians.append(front)
    gaussians.append(back)
    sight = Covisibility(gaussians, CAMERA).look(np.eye(4))
    assert sight.seen.all()


def test_behind_the_camera_and_in_an_empty_map_nothing_is_seen(device: str) -> None:
    gaussians = GaussianMap(device=device, has_identity=False)
    covisibility = Covisibility(gaussians, CAMERA)
    empty = covisibility.look(np.eye(4))
    assert empty.seen.shape == (0,) and np.isnan(empty.median_depth)
    gaussians.append(wall(1.0, 0.05, 0.9))
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert not covisibility.look(away).seen.any()


def test_sets() -> None:
    a, b = np.array([1, 1, 1, 0, 0], bool), np.array([0, 1, 1, 1, 1], bool)
    assert intersection_over_union(a, b) == 2 / 5
    assert overlap_coefficient(a, b) == 2 / 3
    nothing = np.zeros(5, bool)
    assert intersection_over_union(nothing, nothing) == 0.0
    assert overlap_coefficient(a, nothing) == 0.0
