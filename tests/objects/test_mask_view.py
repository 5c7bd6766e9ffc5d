# SPDX-License-Identifier: Apache-2.0
"""Where a frame's pixels are, and what its mask asks of the map."""

from collections.abc import Callable

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.objects.mask_view import MapKnowledge, MaskView, PosedDepth, targets_without_mask

CAMERA = Camera(60, 40, 50.0, 50.0, 29.5, 19.5)


def test_points_and_pixels_are_each_other_s_inverse() -> None:
    rng = np.random.default_rng(1)
    T_wc = se3.se3_exp(rng.normal(size=6) * 0.3)
    view = PosedDepth(rng.uniform(1.0, 3.0, (40, 60)).astype(np.float32), T_wc, CAMERA)
    numbers = np.arange(40 * 60, dtype=np.int32).reshape(40, 60)
    assert view.look_up(view.points(numbers >= 0, 9999), numbers).tolist() == list(range(40 * 60))


def test_only_points_that_a_view_shows_are_looked_up(wall_from: Callable) -> None:
    view, square = wall_from(0.0)
    points = view.points(square, 64)
    in_front = PosedDepth(np.full((40, 60), 1.0, np.float32), view.T_wc, CAMERA)
    labels = square.astype(np.int32)
    assert len(in_front.look_up(points, labels)) == 0
    assert (view.look_up(points, labels) == 1).all()
    assert len(wall_from(50.0)[0].look_up(points, labels)) == 0


def test_large_images_are_counted_on_a_grid() -> None:
    small, large = (np.zeros(shape, np.float32) for shape in ((170, 300), (680, 1200)))
    assert small[PosedDepth(small, np.eye(4), CAMERA).grid].shape == small.shape
    assert 40_000 < large[PosedDepth(large, np.eye(4), CAMERA).grid].size < 60_000


def test_points_of_the_grid_are_those_of_its_pixels(rng: np.random.Generator) -> None:
    camera = Camera(800, 500, 500.0, 500.0, 399.5, 249.5)
    depth = rng.uniform(1.0, 3.0, (500, 800)).astype(np.float32)
    surface = PosedDepth(depth, se3.se3_exp(rng.normal(size=6) * 0.3), camera)
    pixels = np.zeros(depth.shape, bool)
    pixels[surface.grid] = True
    assert pixels.sum() < depth.size / 3, "a large image is thinned"
    np.testing.assert_array_equal(surface.grid_points.reshape(-1, 3), surface.every_point(pixels))


def test_what_the_map_is_certain_of_is_not_learnt_otherwise(wall_from: Callable) -> None:
    view, square = wall_from(0.0)
    labels = np.where(square, 2, -1).astype(np.int32)
    certain = np.full_like(labels, -1)
    certain[:20] = 1
    mask = MaskView(view, labels, MapKnowledge(certain, certain, certain))
    targets = mask.label_targets()
    assert targets.votes is labels and (targets.seeds == 2).all()
    assert (targets.training[20:] == labels[20:]).all() and (targets.training[:20] == -1).all()
    assert MaskView(view, labels).label_targets().training is labels


def test_without_a_mask_nothing_votes() -> None:
    seen = np.full((4, 6), -1, np.int32)
    assert (targets_without_mask(seen).seeds == 0).all()
    seen[0, 0] = 3
    targets = targets_without_mask(seen)
    assert (targets.votes == -1).all() and (targets.training == -1).all() and (targets.seeds == 3).all()
