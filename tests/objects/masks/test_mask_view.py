# SPDX-License-Identifier: Apache-2.0
"""Where a frame's pixels are, and what its mask asks of the map."""

from collections.abc import Callable

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.objects.masks.mask_view import MapKnowledge, MaskView, PosedDepth, targets_without_mask

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


def test_places_are_the_points_that_pixels_show(rng: np.random.Generator) -> None:
    depth = rng.uniform(1.0, 3.0, (40, 60)).astype(np.float32)
    T_wc = se3.se3_exp(rng.normal(size=6) * 0.3)
    rows, columns = np.indices(depth.shape)
    expected = se3.transform_points(
        T_wc, CAMERA.back_project(columns, rows, depth.astype(float)).reshape(-1, 3)
    )
    np.testing.assert_allclose(PosedDepth(depth, T_wc, CAMERA).places.T, expected, atol=1e-5)


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
