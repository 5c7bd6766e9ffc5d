# SPDX-License-Identifier: Apache-2.0
"""Two keyframes' surfaces laid on each other: the motion refined, or the loop refused."""

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


def refine(*arguments, device="cpu"):
    return SurfaceRegistration(device=device).refine(*arguments)


def size(T):
    return np.linalg.norm(se3.se3_log(T))


def test_surfaces_say_it_better_than_features(views, device):
    a, b, _, T_ab = views
    refined, information = refine(a, b, T_ab @ OFF, LOOSE, device=device)
    assert size(se3.inverse(T_ab) @ refined) < 0.1 * size(OFF)
    assert np.linalg.eigvalsh(information - LOOSE)[0] > 0.0, "surfaces add to what is known"


def test_other_places_are_refused(views):
    a, b, elsewhere, T_ab = views
    assert refine(a, elsewhere, T_ab, LOOSE) is None
    assert refine(a, b, se3.se3_exp([0.0, 0.0, 1.5, 0.0, 0.5, 0.0]), LOOSE) is None


def test_features_that_are_sure_of_another_motion_are_refused(views):
    a, b, _, T_ab = views
    assert refine(a, b, T_ab @ OFF, TIGHT) is None
    assert refine(a, b, T_ab, TIGHT) is not None


def test_along_a_wall_features_have_the_last_word():
    camera = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
    wall = surface(np.full((120, 160), 2.0, np.float32), camera)
    T_ab = se3.se3_exp([0.03, 0.02, 0.01, 0.0, 0.0, 0.0])
    refined, _ = refine(wall, wall, T_ab, LOOSE)
    np.testing.assert_allclose(refined[:3, 3], [0.03, 0.02, 0.0], atol=2e-3)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_few_points_say_nothing(views, count):
    a, _, _, T_ab = views
    far = np.full((count, 3), 50.0, np.float32)
    quats, spreads = np.eye(4, dtype=np.float32)[[0] * count], np.full((count, 3), 0.01, np.float32)
    few = Surface.of(FramePoints(far, quats, spreads, far[:, 0], far[:, 0]))
    assert refine(a, few, T_ab, LOOSE) is None
    assert refine(few, a, T_ab, LOOSE) is None


def test_it_is_thinned():
    seen = points_of(np.full((120, 160), 2.0, np.float32), Camera(160, 120, 140.0, 140.0, 79.5, 59.5))
    many = FramePoints(
        *(np.tile(x, (6, 1)) for x in (seen.points, seen.quats, seen.spreads)), seen.noise, seen.noise
    )
    assert 4000 <= len(Surface.of(many).points) < 8000
