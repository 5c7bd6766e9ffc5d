# SPDX-License-Identifier: Apache-2.0
"""Following a segment from view to view by points on its surface."""

from collections.abc import Callable

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.objects.masks.mask_view import PosedDepth
from ggwarp.objects.masks.tentative import Candidates

CAMERA = Camera(60, 40, 50.0, 50.0, 29.5, 19.5)


def test_a_segment_is_recognised_from_elsewhere(wall_from: Callable) -> None:
    candidates = Candidates(2)
    for number, x, z in ((3, 0.0, 2.0), (1, 0.2, 1.8), (2, -0.2, 1.5)):
        view, square = wall_from(x, z)
        found = candidates.follow(np.where(square, number, 0).astype(np.int32), {number}, view)
        assert [s for s, _ in found] == ([] if number == 3 else [number])


def test_views_that_show_the_whole_speak_against_it(wall_from: Callable) -> None:
    candidates = Candidates(2)
    view, square = wall_from(0.0)
    apart, whole = square.astype(np.int32), np.zeros((40, 60), np.int32)
    assert candidates.follow(apart, {1}, view) == []
    assert candidates.follow(whole, set(), view) == []
    assert candidates.follow(apart, {1}, view) == [], "forgotten, and begun anew"
    assert len(candidates.follow(apart, {1}, view)) == 1


def test_a_segment_without_depth_is_not_followed(wall_from: Callable) -> None:
    view, square = wall_from(0.0)
    blind = PosedDepth(np.zeros_like(view.depth), view.T_wc, CAMERA)
    candidates = Candidates(1)
    for _ in range(3):
        assert candidates.follow(square.astype(np.int32), {1}, blind) == []
