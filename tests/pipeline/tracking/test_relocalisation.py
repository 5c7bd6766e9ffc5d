# SPDX-License-Identifier: Apache-2.0
"""Remembered views, on a ray-cast room whose surfaces carry a pattern."""

import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.pipeline.tracking.gicp import GicpConfig, GicpTracker
from ggwarp.pipeline.tracking.point_map import TrackableConfig, TrackableMap
from ggwarp.pipeline.tracking.relocalisation import MAX_CANDIDATES, Relocaliser
from ggwarp.types import Frame, Verdict

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
HALF = np.array([2.0, 1.3, 3.0])
BOXES = ([1.4, 0.9, 2.4, 0.5], [-1.3, 0.6, -2.2, 0.6], [0.4, -0.9, 2.6, 0.35])  # centre, radius


def seen(T_wc, i=0):
    """A frame in a box of a room with balls in it; brightness is a smooth pattern in space."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    rays, origin = rays @ T_wc[:3, :3].T, T_wc[:3, 3]
    with np.errstate(divide="ignore"):
        depth = np.where(rays > 0, (HALF - origin) / rays, (-HALF - origin) / rays).min(-1)
    for *centre, radius in BOXES:
        a, b = (rays**2).sum(-1), rays @ (origin - centre)
        root = b * b - a * (((origin - centre) ** 2).sum() - radius**2)
        hit = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, -1.0)
        depth = np.where(hit > 0, np.minimum(depth, hit), depth)
    x = origin + rays * depth[..., None]
    grey = 128 + 100 * np.sin(2.1 * x[..., 0] + 1.3 * x[..., 2]) * np.cos(1.7 * x[..., 1] - 0.9 * x[..., 2])
    return Frame(i, i / 30.0, np.repeat(grey[..., None], 3, -1).astype(np.uint8), depth.astype(np.float32))


def turned(angle, x=0.0):
    return se3.se3_exp([x, 0.0, 0.0, 0.0, angle, 0.0])


@pytest.fixture
def relocaliser():
    relocaliser = Relocaliser(CAMERA)
    for angle in np.arange(0.0, 5.9, 0.4):
        relocaliser.remember(seen(turned(angle)), turned(angle))
    return relocaliser


def test_views_are_kept_apart(relocaliser):
    assert len(relocaliser) == 15
    relocaliser.remember(seen(turned(0.1)), turned(0.1))
    assert len(relocaliser) == 15
    relocaliser.remember(seen(turned(0.0, 0.4)), turned(0.0, 0.4))
    assert len(relocaliser) == 16


def test_true_poses_are_consistent_and_wrong_ones_are_not(relocaliser):
    for angle in (0.25, 1.0, 2.7, 4.1):
        T = turned(angle, 0.15)
        frame = seen(T)
        found = relocaliser.verify(frame, T)
        assert found.is_consistent and found.shared > 0.6
        assert found.through < 0.05 and found.correlation > 0.9
        for wrong in (turned(angle + 0.7), turned(angle + np.pi), T @ se3.se3_exp([0, 0, -1.0, 0, 0, 0])):
            assert not relocaliser.verify(frame, wrong).is_consistent


def test_a_pose_where_nothing_was_seen_is_not_consistent(relocaliser):
    T = se3.se3_exp([0.0, 50.0, 0.0, 0.0, 0.0, 0.0])
    assert relocaliser.verify(seen(turned(0.0)), T).shared == 0.0
    assert not relocaliser.verify(seen(turned(0.0)), T).is_consistent


def test_brightness_tells_apart_what_depth_cannot():
    relocaliser = Relocaliser(CAMERA)
    frame = seen(np.eye(4))
    relocaliser.remember(frame, np.eye(4))
    assert relocaliser.verify(frame, np.eye(4)).is_consistent
    negative = Frame(1, 0.0, 255 - frame.rgb, frame.depth)
    assert relocaliser.verify(negative, np.eye(4)).correlation < -0.99
    assert not relocaliser.verify(negative, np.eye(4)).is_consistent
    without = Frame(1, 0.0, np.zeros((1, 1, 3), np.uint8), frame.depth)
    assert relocaliser.verify(without, np.eye(4)).is_consistent


def test_candidate_poses_lead_to_where_the_frame_was_taken(relocaliser):
    for angle in (0.9, 2.5, 5.0):
        T = turned(angle, 0.2)
        poses = relocaliser.candidate_poses(seen(T), [turned(angle + 2.0)])
        assert len(poses) <= MAX_CANDIDATES
        gaps = [se3.se3_log(se3.inverse(T) @ pose) for pose in poses]
        assert min(np.abs(gap).max() for gap in gaps) < 0.35


def test_a_frame_without_readings_is_nowhere(relocaliser):
    empty = Frame(0, 0.0, np.zeros((120, 160, 3), np.uint8), np.zeros((120, 160), np.float32))
    assert relocaliser.verify(empty, np.eye(4)).shared == 0.0
    assert len(relocaliser.candidate_poses(empty, [np.eye(4)])) > 0


class Walk:
    """A tracker that turns on the spot."""

    def __init__(self):
        self.tracker = GicpTracker(GicpConfig(points=3000), CAMERA)
        self.map = TrackableMap(TrackableConfig())
        self.map.add(self.tracker.start(seen(turned(0.0)), turned(0.0)).points, turned(0.0))

    def track(self, i, T):
        result = self.tracker.track(seen(T, i), self.map.snapshot())
        if result.verdict is not Verdict.LOST:
            self.map.add(result.points, result.T_wc)
        return result


def test_a_camera_carried_off_is_found_again_and_nowhere_else():
    walk = Walk()
    for i in range(1, 9):
        assert walk.track(i, turned(0.25 * i)).verdict is not Verdict.LOST
    carried = walk.track(9, turned(0.2, 0.1))
    assert np.abs(se3.se3_log(se3.inverse(turned(0.2, 0.1)) @ carried.T_wc)).max() < 0.02
    assert carried.verdict is Verdict.POOR and "jump" in carried.reason
    away = walk.track(10, turned(4.6))
    assert away.verdict is Verdict.LOST and "earlier views" in away.reason


def test_recovery_is_the_same_to_the_bit():
    runs = []
    for _ in range(2):
        walk = Walk()
        runs.append([walk.track(i, turned(angle)).T_wc for i, angle in enumerate((0.3, 0.6, 3.3, 0.1), 1)])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_a_tracker_goes_on_in_a_map_that_was_moved():
    walk = Walk()
    for i in range(1, 4):
        walk.track(i, turned(0.25 * i))
    motion = se3.se3_exp([0.4, -0.2, 0.1, 0.0, 0.0, 0.7])
    correction = PoseCorrection((0,), motion[None])
    walk.map.move(correction)
    walk.tracker.on_map_moved(correction, 3)
    for i, angle in enumerate((1.0, 0.2), 4):  # on, and back by more than it may have moved
        found = walk.track(i, turned(angle))
        assert found.verdict is not Verdict.LOST
        error = se3.se3_log(se3.inverse(motion @ turned(angle)) @ found.T_wc)
        assert np.abs(error).max() < 0.02
