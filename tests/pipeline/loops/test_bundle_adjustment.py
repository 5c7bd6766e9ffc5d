# SPDX-License-Identifier: Apache-2.0
"""Poses and points of a made-up scene from where pictures show them."""

import numpy as np
import pytest

from ggwarp.evaluation.trajectory import absolute_error
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.bundle_adjustment import (
    Observations,
    adjust_bundle,
    reprojection_errors,
    resect,
    triangulate_points,
)

CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
VIEWS, POINTS = 8, 120


def scene(rng, noise=0.0):
    """Return true poses along a wall, true points before it, and where the pictures show them."""
    points = np.stack(
        [rng.uniform(-1.5, 2.5, POINTS), rng.uniform(-1, 1, POINTS), rng.uniform(2, 4, POINTS)], axis=1
    )
    poses = np.stack([se3.se3_exp([0.12 * k, 0.02 * k, 0.0, 0.0, -0.02 * k, 0.0]) for k in range(VIEWS)])
    views, numbers, pixels = [], [], []
    for view, T in enumerate(poses):
        local = se3.transform_points(se3.inverse(T), points)
        at = local[:, :2] / local[:, 2:] * 200.0 + (159.5, 119.5)
        seen = (local[:, 2] > 0.1) & (at >= 0).all(axis=1) & (at < (320, 240)).all(axis=1)
        views.append(np.full(seen.sum(), view))
        numbers.append(np.flatnonzero(seen))
        pixels.append(at[seen] + noise * rng.standard_normal((seen.sum(), 2)))
    return poses, points, Observations(*(np.concatenate(rows) for rows in (views, numbers, pixels)))


def test_rays_meet_at_the_point_and_errors_are_none_there(rng):
    poses, points, seen = scene(rng)
    found = triangulate_points(CAMERA, poses, seen, POINTS)
    known = np.isfinite(found).all(axis=1)
    assert known.mean() > 0.8
    np.testing.assert_allclose(found[known], points[known], atol=1e-8)
    errors = reprojection_errors(CAMERA, poses, found, seen)
    assert errors[known[seen.points]].max() < 1e-6 and np.isinf(errors[~known[seen.points]]).all()


def test_a_turn_on_the_spot_tells_no_distance(rng):
    _, points, seen = scene(rng)
    poses = np.stack([se3.se3_exp([0, 0, 0, 0, 0.02 * k, 0]) for k in range(VIEWS)])
    rays = [se3.transform_points(se3.inverse(T), points) for T in poses]
    pixels = np.array([r[p, :2] / r[p, 2] * 200 + (159.5, 119.5) for r, p in
                       ((rays[v], p) for v, p in zip(seen.views, seen.points, strict=True))])  # fmt: skip
    found = triangulate_points(CAMERA, poses, Observations(seen.views, seen.points, pixels), POINTS)
    assert np.isnan(found).all()


def test_a_point_behind_the_camera_is_no_match(rng):
    poses, points, seen = scene(rng)
    assert np.isinf(reprojection_errors(CAMERA, poses, points * (1, 1, -1), seen)).all()


def test_poses_that_have_lost_their_scale_find_it_again(rng):
    pytest.importorskip("gtsam", reason="no wheels for this Python")
    poses, _, seen = scene(rng, noise=0.3)
    drifted = [poses[0]]
    for k in range(VIEWS - 1):
        step = se3.inverse(poses[k]) @ poses[k + 1]
        step[:3, 3] *= 1.05**k
        drifted.append(drifted[-1] @ step @ se3.se3_exp(0.003 * rng.standard_normal(6)))
    drifted = np.stack(drifted)
    wrong = rng.permutation(len(seen.views))[:20]  # matches that are none
    seen.pixels[wrong] += rng.uniform(20, 60, (20, 2))
    fixed = np.arange(VIEWS) == 0
    found, at = adjust_bundle(CAMERA, drifted, seen, POINTS, fixed=fixed, depth=3.0, gates=(30.0, 6.0))
    before, after = (absolute_error(p, poses, with_scale=True).rmse for p in (drifted, found))
    assert after < 0.003 < 0.25 * before
    np.testing.assert_array_equal(found[0], drifted[0])
    assert np.isfinite(at).all(axis=1).mean() > 0.7


def test_poses_that_are_fixed_keep_their_bits_and_hold_the_rest(rng):
    pytest.importorskip("gtsam", reason="no wheels for this Python")
    poses, points, seen = scene(rng, noise=0.1)
    start = poses.copy()
    start[5:, :3, 3] += 0.02
    fixed = np.arange(VIEWS) < 5
    found, at = adjust_bundle(CAMERA, start, seen, POINTS, fixed=fixed, depth=3.0)
    np.testing.assert_array_equal(found[:5], poses[:5])
    assert np.linalg.norm(found[5:, :3, 3] - poses[5:, :3, 3], axis=1).max() < 0.004
    again, _ = adjust_bundle(CAMERA, start, seen, POINTS, fixed=fixed, depth=3.0)
    np.testing.assert_array_equal(again, found)
    known = np.isfinite(at).all(axis=1)
    assert np.median(np.linalg.norm(at[known] - points[known], axis=1)) < 0.03


def test_a_picture_of_known_points_has_its_pose(rng):
    poses, points, seen = scene(rng, noise=0.2)
    here = seen.only(seen.views == 4)
    start = poses[4] @ se3.se3_exp([0.1, -0.05, 0.08, 0.03, -0.02, 0.04])
    here.pixels[:10] += 40.0
    found, agreeing = resect(CAMERA, start, points[here.points], here.pixels)
    assert np.abs(se3.se3_log(se3.inverse(poses[4]) @ found)).max() < 0.005
    assert agreeing == len(here.points) - 10


def test_nothing_seen_leaves_poses_where_they_are(rng):
    pytest.importorskip("gtsam", reason="no wheels for this Python")
    poses, _, seen = scene(rng)
    nothing = seen.only(np.zeros(len(seen.views), bool))
    found, at = adjust_bundle(CAMERA, poses, nothing, 0, fixed=np.arange(VIEWS) == 0, depth=3.0)
    np.testing.assert_allclose(found, poses, atol=1e-6)
    assert at.shape == (0, 3)
