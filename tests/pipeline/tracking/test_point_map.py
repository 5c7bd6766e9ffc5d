# SPDX-License-Identifier: Apache-2.0
"""Trackable points that move with their keyframes."""

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.pipeline.tracking.point_map import TrackableConfig, TrackableMap
from ggwarp.types import FramePoints


def patch(z: float, *, step: float = 0.01, n: int = 20) -> FramePoints:
    """A square of wall at ``z``, all of it new to the map."""
    x, y = np.meshgrid(np.arange(n) * step, np.arange(n) * step)
    points = np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], axis=1).astype(np.float32)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n * n, 1))
    return FramePoints(
        points,
        quats,
        np.full((n * n, 3), 0.01, np.float32),
        np.full(n * n, 0.002, np.float32),
        np.full(n * n, np.inf, np.float32),
    )


def made(device: str) -> TrackableMap:
    points = TrackableMap(TrackableConfig(), device=device)
    points.add(patch(1.0), np.eye(4), 0)
    points.add(patch(2.0), se3.se3_exp([0.1, 0, 0, 0, 0.2, 0]), 7)
    return points


def test_points_and_their_ellipses_follow_their_keyframe(device):
    points = made(device)
    before = points.snapshot()
    motion = se3.se3_exp([0.0, 0.3, 0.0, 0.5, 0, 0])
    points.move(PoseCorrection((0, 7), np.stack([np.eye(4), motion])))
    after = points.snapshot()
    assert after.version == before.version + 1 and after.count == before.count == 800
    for name in ("means", "quats", "scales"):
        np.testing.assert_array_equal(getattr(after, name).numpy()[:400], getattr(before, name).numpy()[:400])
    means, quats = before.means.numpy()[400:], before.quats.numpy()[400:]
    np.testing.assert_allclose(after.means.numpy()[400:], se3.transform_points(motion, means), atol=1e-6)
    np.testing.assert_allclose(
        np.abs(np.sum(after.quats.numpy()[400:] * se3.rotate_quats(motion[:3, :3], quats), axis=1)),
        1.0,
        atol=1e-6,
    )


def test_motions_do_not_wear_points_out(device):
    points = made(device)
    before = points.snapshot().means.numpy()
    there = se3.se3_exp([1.0, -0.5, 0.2, 0.3, 0.1, -0.4])
    for motion in [there, se3.inverse(there)] * 20:
        points.move(PoseCorrection((0, 7), np.stack([np.eye(4), motion])))
    np.testing.assert_allclose(points.snapshot().means.numpy(), before, atol=1e-6)


def test_layers_that_come_to_lie_on_each_other_become_one(device):
    points = TrackableMap(TrackableConfig(), device=device)
    points.add(patch(1.0), np.eye(4), 0)
    drifted = se3.se3_exp([0.0, 0.0, 0.1, 0, 0, 0])
    points.add(patch(1.0, n=30), drifted, 50)  # the same wall seen again, and more of it
    assert len(points) == 1300
    points.move(PoseCorrection((0, 50), np.stack([np.eye(4), se3.inverse(drifted)])))
    means = points.snapshot().means.numpy()
    np.testing.assert_allclose(means[:, 2], 1.0, atol=1e-6)
    np.testing.assert_array_equal(means[:400], patch(1.0).points)  # the earlier layer stays, whole
    reach = TrackableConfig().distance
    outside = np.maximum(means[400:, 0], means[400:, 1]) - 0.19
    assert 300 < len(means) - 400 < 500 and (outside > 0.7 * reach).all()


def test_an_empty_map_moves(device):
    points = TrackableMap(TrackableConfig(), device=device)
    points.move(PoseCorrection((0,), np.eye(4)[None]))
    assert points.snapshot().count == 0
