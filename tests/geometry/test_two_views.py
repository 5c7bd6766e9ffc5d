# SPDX-License-Identifier: Apache-2.0
"""Depth from motion: exact matches give exact depth, real pictures give good matches."""

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.two_views import (
    InverseDepth,
    Matcher,
    Matches,
    fuse,
    grey,
    pose_from_depth,
    rays_of,
    relative_pose,
    triangulate,
)
from ggwarp.types import Frame

CAMERA = Camera(60, 40, 50.0, 52.0, 29.0, 20.5)
MOTION = se3.se3_exp([0.1, -0.03, 0.05, 0.02, -0.04, 0.03])


@pytest.fixture
def depth(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(1.0, 4.0, (CAMERA.height, CAMERA.width))


def seen_from(depth: np.ndarray, T_other: np.ndarray, camera: Camera) -> Matches:
    """The exact matches of every pixel."""
    points = rays_of(camera) * depth[..., None] @ T_other[:3, :3].T + T_other[:3, 3]
    at = points[..., :2] / points[..., 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return Matches(at, np.ones(depth.shape, bool))


def test_exact_matches_give_the_depth_and_how_well_it_is_known(depth: np.ndarray) -> None:
    found = triangulate(seen_from(depth, MOTION, CAMERA), MOTION, CAMERA)
    assert (found.weight > 0.0).all()
    np.testing.assert_allclose(found.depth(), depth, rtol=1e-5)
    twice = MOTION.copy()
    twice[:3, 3] *= 2.0
    farther = triangulate(seen_from(depth, twice, CAMERA), twice, CAMERA)
    np.testing.assert_allclose(np.median(farther.weight / found.weight), 4.0, rtol=0.1)
    assert farther.known(0.1).mean() > found.known(0.1).mean()


def test_the_weight_is_the_inverse_variance(depth: np.ndarray, rng: np.random.Generator) -> None:
    matches = seen_from(depth, MOTION, CAMERA)
    noisy = Matches(matches.at + rng.normal(0.0, 0.25, matches.at.shape), matches.good)
    found = triangulate(noisy, MOTION, CAMERA)
    good = found.weight > 0.0
    z = (found.value - 1.0 / depth)[good] * np.sqrt(found.weight[good])
    assert 0.85 < np.std(z) < 1.15


def test_turning_on_the_spot_tells_nothing(depth: np.ndarray) -> None:
    turn = se3.se3_exp([0.0, 0.0, 0.0, 0.1, 0.05, 0.0])
    assert not triangulate(seen_from(depth, turn, CAMERA), turn, CAMERA).known(0.2).any()


def test_matches_off_their_line_or_behind_tell_nothing(depth: np.ndarray) -> None:
    matches = seen_from(depth, MOTION, CAMERA)
    line = MOTION[:3, 3] / MOTION[2, 3]
    away = np.array([-line[1] + 0.3, line[0]])  # across the epipolar lines, more or less
    off = Matches(matches.at + 8.0 * away, matches.good)
    backwards = MOTION.copy()
    backwards[:3, 3] *= -1.0
    assert triangulate(off, MOTION, CAMERA).known(0.2).mean() < 0.2
    assert not triangulate(matches, backwards, CAMERA).known(0.2).any()


def test_motion_from_matches_alone(depth: np.ndarray, rng: np.random.Generator) -> None:
    matches = seen_from(depth, MOTION, CAMERA)
    wrong = rng.random(depth.shape) < 0.2
    matches.at[wrong] += rng.uniform(-20.0, 20.0, (np.count_nonzero(wrong), 2))
    found = relative_pose(matches, CAMERA)
    assert found is not None
    T, share = found
    assert 0.7 < share < 0.9
    np.testing.assert_allclose(T[:3, :3], MOTION[:3, :3], atol=2e-3)
    np.testing.assert_allclose(T[:3, 3], MOTION[:3, 3] / np.linalg.norm(MOTION[:3, 3]), atol=5e-2)
    assert relative_pose(Matches(matches.at, wrong & (matches.at[..., 0] < 5.0)), CAMERA) is None


@pytest.mark.parametrize("seed", range(4))
def test_a_scene_that_is_nearly_a_plane_does_not_mislead(seed: int) -> None:
    """Its other motion, turned by more and moved elsewhere, fits the matches almost as well."""
    rng, camera = np.random.default_rng(seed), Camera(256, 192, 210.0, 210.0, 127.5, 95.5)
    rays, normal = rays_of(camera), np.array([0.15, -0.5, 0.85])
    depth = 2.0 / (rays @ normal) * (1.0 + 0.03 * rng.standard_normal(rays.shape[:2]))
    motion = se3.se3_exp([-0.06, 0.01, 0.01, 0.01, -0.03, 0.01])
    matches = seen_from(depth, motion, camera)
    matches.at[:] += 0.25 * rng.standard_normal(matches.at.shape)
    found = relative_pose(matches, camera)
    assert found is not None
    turn = se3.so3_log(found[0][:3, :3].T @ motion[:3, :3])
    along = motion[:3, 3] / np.linalg.norm(motion[:3, 3])
    assert np.degrees(np.linalg.norm(turn)) < 0.5
    assert np.degrees(np.arccos(found[0][:3, 3] @ along)) < 12.0


def test_motion_from_depth(depth: np.ndarray, rng: np.random.Generator) -> None:
    matches = seen_from(depth, MOTION, CAMERA)
    wrong = rng.random(depth.shape) < 0.2
    matches.at[wrong] += rng.uniform(3.0, 20.0, (np.count_nonzero(wrong), 2))
    half = np.where(rng.random(depth.shape) < 0.5, depth, 0.0).astype(np.float32)
    found = pose_from_depth(matches, half, CAMERA, np.eye(4))
    assert found is not None
    np.testing.assert_allclose(found[0], MOTION, atol=1e-3)
    assert 0.7 < found[1] < 0.9
    assert pose_from_depth(matches, 0.0 * half, CAMERA, np.eye(4)) is None


def test_estimates_are_weighed_and_contradictions_dropped() -> None:
    def row(value: list[float], weight: list[float]) -> InverseDepth:
        return InverseDepth(np.array([value], np.float32), np.array([weight], np.float32))

    both = fuse(
        [row([0.5, 0.5, 0.0, 0.5], [1e4, 1e4, 0.0, 0.0]), row([0.52, 0.9, 0.0, 0.4], [3e4, 1e4, 0.0, 2.0])]
    )
    np.testing.assert_allclose(both.value, [[0.515, 0.0, 0.0, 0.4]], rtol=1e-6)
    np.testing.assert_allclose(both.weight, [[4e4, 0.0, 0.0, 2.0]])


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    office = SyntheticOffice(scale=0.2)
    return [office[i] for i in (0, 2)]


def test_pictures_are_matched(frames: list[Frame]) -> None:
    office, (a, b) = SyntheticOffice(scale=0.2), frames
    assert a.depth is not None and a.T_wc is not None and b.T_wc is not None
    matches = Matcher().match(grey(a.rgb), grey(b.rgb))
    T_other = se3.inverse(b.T_wc) @ a.T_wc
    true = seen_from(a.depth, T_other, office.camera)
    assert matches.share > 0.6
    error = np.linalg.norm(matches.at - true.at, axis=-1)[matches.good]
    assert np.median(error) < 0.25 and np.percentile(error, 90) < 0.7
    found = triangulate(matches, T_other, office.camera)
    known = found.known(0.15)
    assert known.mean() > 0.3
    assert np.median(np.abs(found.depth() / a.depth - 1.0)[known]) < 0.06
