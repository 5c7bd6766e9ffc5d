# SPDX-License-Identifier: Apache-2.0
"""Two keyframes' surfaces laid on each other: a loop that they agree with, or that they refuse."""

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.surface_registration import Surface, SurfaceRegistration
from ggwarp.pipeline.tracking.preprocess import ObservationConfig, observe
from ggwarp.types import FramePoints

OFFICE = SyntheticOffice(scale=0.2)
LOOSE, TIGHT = np.eye(6) / 0.03**2, np.eye(6) / 0.001**2
OFF = se3.se3_exp([0.02, -0.015, 0.01, 0.01, -0.008, 0.005])


def points_of(depth, camera):
    seen = observe(depth, camera, ObservationConfig(points=3000), device="cpu")
    arrays = (x.numpy() for x in (seen.cloud.points, seen.quats, seen.spreads))
    return FramePoints(*arrays, noise=seen.noise, distances2=seen.noise)


def surface(depth, camera=OFFICE.camera):
    return Surface.of(points_of(depth, camera))


@pytest.fixture(scope="module")
def views():
    """Surfaces of two near frames and of one that looks elsewhere; the motion between the first two."""
    frames = [OFFICE[i] for i in (0, 6, 60)]
    T_ab = se3.inverse(frames[0].T_wc) @ frames[1].T_wc
    return *(surface(f.depth) for f in frames), T_ab


def agree(*arguments, device="cpu"):
    return SurfaceRegistration(device=device).agree(*arguments)


def test_what_features_are_unsure_of_by_centimetres_is_agreed_with(views, device):
    a, b, _, T_ab = views
    assert agree(a, b, T_ab, LOOSE, device=device) and agree(a, b, T_ab @ OFF, LOOSE, device=device)


def test_other_places_are_refused(views):
    a, b, elsewhere, T_ab = views
    assert not agree(a, elsewhere, T_ab, LOOSE)
    assert not agree(a, b, se3.se3_exp([0.0, 0.0, 1.5, 0.0, 0.5, 0.0]), LOOSE)


def test_features_that_are_sure_of_another_motion_are_refused(views):
    a, b, _, T_ab = views
    assert not agree(a, b, T_ab @ OFF, TIGHT)
    assert agree(a, b, T_ab, TIGHT)


def test_a_third_of_a_view_is_enough(views):
    """Where a place is seen again from another side, most of a view is of something else."""
    a, b, elsewhere, T_ab = views
    third = slice(None, None, 3)
    away = elsewhere.points + np.float32([20.0, 0.0, 0.0])
    points = np.concatenate([b.points[third], away[: 2 * len(b.points) // 3]])
    quats = np.concatenate([b.quats[third], elsewhere.quats[: 2 * len(b.points) // 3]])
    spreads = np.concatenate([b.spreads[third], elsewhere.spreads[: 2 * len(b.points) // 3]])
    mixed = Surface(points, quats, spreads, b.spacing)
    assert agree(a, mixed, T_ab @ OFF, LOOSE) and not agree(a, mixed, T_ab @ OFF, TIGHT)


def test_along_a_wall_features_have_the_last_word():
    camera = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
    wall = surface(np.full((120, 160), 2.0, np.float32), camera)
    assert agree(wall, wall, se3.se3_exp([0.03, 0.02, 0.0, 0.0, 0.0, 0.0]), TIGHT)
    assert not agree(wall, wall, se3.se3_exp([0.0, 0.0, 0.03, 0.0, 0.0, 0.0]), TIGHT)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_few_points_say_nothing(views, count):
    a, _, _, T_ab = views
    far = np.full((count, 3), 50.0, np.float32)
    quats, spreads = np.eye(4, dtype=np.float32)[[0] * count], np.full((count, 3), 0.01, np.float32)
    few = Surface.of(FramePoints(far, quats, spreads, far[:, 0], far[:, 0]))
    assert not agree(a, few, T_ab, LOOSE)
    assert not agree(few, a, T_ab, LOOSE)


def test_it_is_thinned():
    seen = points_of(np.full((120, 160), 2.0, np.float32), Camera(160, 120, 140.0, 140.0, 79.5, 59.5))
    many = FramePoints(
        *(np.tile(x, (6, 1)) for x in (seen.points, seen.quats, seen.spreads)), seen.noise, seen.noise
    )
    assert 1500 <= len(Surface.of(many).points) < 3000 < len(many.points)
