# SPDX-License-Identifier: Apache-2.0
"""Tracking on small ray-cast rooms with known motion."""

from dataclasses import replace

import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.tracking import gicp
from ggwarp.pipeline.tracking.gicp import GicpConfig, GicpTracker
from ggwarp.pipeline.tracking.given_poses import GivenPoses
from ggwarp.pipeline.tracking.point_map import TrackableConfig, TrackableMap
from ggwarp.pipeline.tracking.preprocess import ObservationConfig, observe
from ggwarp.types import Frame, Verdict

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
CONFIG = GicpConfig(points=5000)
WALLS = (
    [0, 0, 1, 3.0],
    [1, 0, 0, 1.6],
    [-1, 0, 0, 1.7],
    [0, 1, 0, 1.1],
    [0, -1, 0, 1.3],
    [0.5, 0.6, 0.62, 2.2],
)


def depth_from(T_wc, camera=CAMERA):
    """Depth of a room of planes n.x = d, seen from inside."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    rays = rays @ T_wc[:3, :3].T
    depth = np.full(u.shape, np.inf)
    for *n, d in WALLS:
        along, gap = rays @ np.array(n), d - np.array(n) @ T_wc[:3, 3]
        with np.errstate(divide="ignore"):
            depth = np.where(along > 1e-9, np.minimum(depth, gap / along), depth)
    return depth.astype(np.float32)


def pose(i):
    return se3.se3_exp([0.02 * i, -0.01 * i, 0.015 * i, 0.01 * i, 0.02 * i, -0.005 * i])


def frame(i, depth=None, **more):
    depth = depth_from(pose(i)) if depth is None else depth
    return Frame(i, i / 30.0, np.zeros((1, 1, 3), np.uint8), depth, **more)


class Session:
    """A tracker and the map it builds from its own first frame."""

    def __init__(self, device="cpu", config=CONFIG, camera=CAMERA):
        self.tracker = GicpTracker(config, camera, device=device)
        self.map = TrackableMap(TrackableConfig(), device=device)
        self.map.add(self.tracker.start(frame(0), pose(0)).points, pose(0))

    def track(self, frame):
        return self.tracker.track(frame, self.map.snapshot())


def error(result, i):
    xi = se3.se3_log(se3.inverse(pose(i)) @ result.T_wc)
    return np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])


def test_known_motion_is_recovered(device):
    session = Session(device)
    for i in range(1, 6):
        result = session.track(frame(i))
        distance, turn = error(result, i)
        assert result.verdict is Verdict.CONVERGED and result.reason == ""
        assert distance < 1e-3 and turn < 5e-4
        assert result.overlap > 0.8 and result.points.rmse < 0.06
        assert session.tracker.registration.iterations > 0


def test_a_large_first_step_is_found_coarse_to_fine():
    session = Session()
    result = session.track(frame(5))
    assert error(result, 5)[0] < 1e-3


def test_the_result_carries_the_points():
    session = Session()
    result = session.track(frame(1))
    points, seen = result.points, observe(depth_from(pose(1)), CAMERA, CONFIG, device="cpu")
    n = len(points.points)
    assert 4000 < n < 6000
    scales, pixels = seen.scales.numpy(), seen.pixels.numpy()
    shapes = [points.points, points.quats, points.spreads, scales, points.distances2, pixels]
    assert [x.shape for x in shapes] == [(n, 3), (n, 4), (n, 3), (n, 3), (n,), (n, 2)]
    u, v = pixels.T
    z = depth_from(pose(1))[v, u]
    np.testing.assert_allclose(points.points[:, 2], z)
    np.testing.assert_allclose(points.points[:, 0], (u - CAMERA.cx) * z / CAMERA.fx, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(points.quats, axis=1), 1.0, atol=1e-5)
    assert (np.diff(scales, axis=1) <= 0.0).all()
    assert result.overlap == points.overlap == np.isfinite(points.distances2).mean()


def test_readings_of_less_confidence_count_less():
    """Every second patch reads too far by a deviation: the less it counts, the less it moves the camera."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    unsure, depth = (v // 20 + u // 20) % 2 == 0, depth_from(pose(1))
    biased = np.where(unsure, depth + CONFIG.depth_noise(depth), depth).astype(np.float32)
    errors = []
    for weight in (None, 0.5, 0.1):
        weights = None if weight is None else np.where(unsure, weight, 1.0).astype(np.float32)
        errors.append(error(Session().track(frame(1, biased, depth_weight=weights)), 1)[0])
    assert errors[1] < 0.9 * errors[0] and errors[2] < 0.5 * errors[0]


@pytest.mark.parametrize("seed", [0, 1])
def test_garbage_is_lost_and_the_pose_predicted(rng, seed):
    session = Session()
    session.track(frame(1))
    noise = np.random.default_rng(seed).uniform(0.2, 8.0, (120, 160)).astype(np.float32)
    result = session.track(frame(2, noise))
    assert result.verdict is Verdict.LOST and "overlap" in result.reason
    assert error(result, 2)[0] < 2e-3


def test_no_depth_is_lost_with_the_reason():
    session = Session()
    result = session.track(frame(1, np.zeros((120, 160), np.float32)))
    assert result.verdict is Verdict.LOST and result.reason.startswith("0 depth points")
    assert len(result.points.points) == 0 and result.overlap == 0.0
    np.testing.assert_allclose(result.T_wc, pose(0))


def test_a_start_without_depth_is_lost_and_can_be_repeated():
    tracker = GicpTracker(CONFIG, CAMERA)
    assert tracker.start(frame(0, np.zeros((120, 160), np.float32)), pose(0)).verdict is Verdict.LOST
    assert tracker.start(frame(1), pose(1)).verdict is Verdict.CONVERGED


def test_a_turn_too_large_for_one_start_is_found_by_search(monkeypatch):
    T = pose(0) @ se3.se3_exp([0.05, 0.02, 0.0, 0.4, 0.0, 0.0])
    turned = frame(1, depth_from(T))
    with monkeypatch.context() as accepting:
        for name, value in (("_SURE_OVERLAP", 0.0), ("_MAX_JUMP", np.inf), ("_MAX_TURN", np.inf)):
            accepting.setattr(gicp, name, value)
        once = Session().track(turned)
    assert np.linalg.norm(se3.se3_log(se3.inverse(T) @ once.T_wc)) > 0.1
    result = Session().track(turned)
    assert result.verdict is Verdict.CONVERGED
    assert np.linalg.norm(se3.se3_log(se3.inverse(T) @ result.T_wc)) < 5e-3


def test_recovers_after_bad_frames():
    session = Session()
    session.track(frame(1))
    for i in (2, 3, 4):
        assert session.track(frame(i, np.full((120, 160), 0.3, np.float32))).verdict is Verdict.LOST
    result = session.track(frame(5))
    assert result.verdict is Verdict.CONVERGED and error(result, 5)[0] < 1e-3
    assert error(session.track(frame(6)), 6)[0] < 1e-3


def test_a_bare_wall_is_poor_because_it_slides():
    def wall(i):
        return Frame(i, i / 30.0, np.zeros((1, 1, 3), np.uint8), np.full((120, 160), 2.0, np.float32))

    tracker = GicpTracker(CONFIG, CAMERA)
    trackable = TrackableMap(TrackableConfig())
    trackable.add(tracker.start(wall(0), np.eye(4)).points, np.eye(4))
    result = tracker.track(wall(1), trackable.snapshot())
    assert result.verdict is Verdict.POOR and "slide" in result.reason
    np.testing.assert_allclose(result.T_wc, np.eye(4), atol=1e-3)


def test_true_poses_are_never_read():
    class Trap:
        def __getattribute__(self, name):
            raise AssertionError("the tracker read the true pose")

    clean, trapped = Session(), Session()
    for i in (1, 2):
        expected = clean.track(frame(i))
        result = trapped.track(frame(i, T_wc=Trap()))
        np.testing.assert_array_equal(result.T_wc, expected.T_wc)


def test_sensor_depth_goes_before_depth():
    session = Session()
    result = session.track(frame(1, np.zeros((12, 16), np.float32), sensor_depth=depth_from(pose(1))))
    assert result.verdict is Verdict.CONVERGED


def test_the_pose_is_that_of_the_colour_image():
    """Depth is taken 15 ms before colour: pose and points are carried over by the camera's velocity."""
    together, apart = Session(), Session()
    for i in (1, 2):
        expected = together.track(frame(i))
        late = replace(frame(i), timestamp=i / 30.0 + 0.015, depth_timestamp=i / 30.0)
        result = apart.track(late)
    step = se3.se3_log(se3.inverse(pose(1)) @ pose(2))
    T_expected = pose(2) @ se3.se3_exp(step * 0.015 * 30.0)
    assert np.linalg.norm(se3.se3_log(se3.inverse(T_expected) @ result.T_wc)) < 2e-3
    np.testing.assert_allclose(
        se3.transform_points(result.T_wc, result.points.points),
        se3.transform_points(expected.T_wc, expected.points.points),
        atol=1e-5,
    )


def test_a_second_run_gives_the_same_bits():
    runs = []
    for _ in range(2):
        session = Session()
        runs.append([session.track(frame(i)).T_wc for i in range(1, 4)])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_wrong_use_is_told():
    tracker = GicpTracker(CONFIG, CAMERA)
    snapshot = TrackableMap(TrackableConfig()).snapshot()
    with pytest.raises(RuntimeError, match="before start"):
        tracker.track(frame(0), snapshot)
    with pytest.raises(ValueError, match="frame 0 has no depth"):
        tracker.start(replace(frame(0), depth=None), np.eye(4))


def test_an_empty_map_is_lost():
    session = Session()
    empty = TrackableMap(TrackableConfig()).snapshot()
    assert session.tracker.track(frame(1), empty).verdict is Verdict.LOST


def test_the_map_grows_by_what_is_new_only():
    session = Session()
    first = len(session.map)
    version = session.map.snapshot().version
    old = session.map.snapshot()
    result = session.track(frame(6))
    added = session.map.add(result.points, result.T_wc)
    least = np.maximum(TrackableConfig().distance, result.points.noise)
    assert added == (result.points.distances2 > least**2).sum()
    assert len(session.map) == first + added and session.map.snapshot().version == version + 1
    assert old.count == first


def test_far_noise_is_matched_and_does_not_fill_space(rng):
    z = 5.0
    noise = float(CONFIG.depth_noise(np.float32(z)))
    assert noise > 1.5 * gicp.OVERLAP_DISTANCE
    walls = [z + noise * rng.standard_normal((CAMERA.height, CAMERA.width)) for _ in range(8)]

    def grown(believed: float) -> tuple[int, TrackableMap, GicpTracker]:
        """How many points the walls after the first add, the noise taken for so many times its size."""
        tracker, trackable = GicpTracker(CONFIG, CAMERA), TrackableMap(TrackableConfig())
        trackable.add(tracker.start(frame(0, walls[0].astype(np.float32)), pose(0)).points, pose(0))
        first = len(trackable)
        for i, wall in enumerate(walls[1:], 1):
            seen = tracker.place(frame(i, wall.astype(np.float32)), trackable.snapshot(), pose(0)).points
            assert seen.overlap > 0.95, "noise alone makes no keyframe"
            trackable.add(replace(seen, noise=believed * seen.noise), pose(0))
        return len(trackable) - first, trackable, tracker

    added, trackable, tracker = grown(1.0)
    assert added < 0.7 * grown(0.0)[0]
    # What is new in front of the wall is let in.
    walls[0][40:80, 60:100] = 4.6
    seen = tracker.place(frame(9, walls[0].astype(np.float32)), trackable.snapshot(), pose(0)).points
    assert trackable.add(seen, pose(0)) > 200


def test_trackable_ellipses_lie_in_the_world():
    session = Session()
    snapshot = session.map.snapshot()
    means, quats, scales = (x.numpy() for x in (snapshot.means, snapshot.quats, snapshot.scales))
    planes = np.array(WALLS)
    planes = planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    gaps = np.abs(means @ planes[:, :3].T - planes[:, 3])
    on = gaps.min(1) < 1e-4
    assert on.mean() > 0.99
    normals = np.array([se3.matrix_from_quat(q)[:, 2] for q in quats])
    cosines = np.abs((normals * planes[gaps.argmin(1), :3]).sum(1))
    assert np.median(cosines) > 0.9999
    noise = 0.001 + 0.002 * means[:, 2] ** 2
    assert (scales[:, :2] == 1.0).all() and (scales[:, 2] > 0.999 * noise).all()
    np.testing.assert_allclose(np.median(scales[:, 2] / noise), 1.0, rtol=1e-3)


@pytest.mark.parametrize("points", [500, 5000])
def test_sampling_adapts_to_the_readings(points):
    image = depth_from(np.eye(4))
    config = ObservationConfig(points=points)
    assert 0.6 * points < observe(image, CAMERA, config, device="cpu").count < 1.6 * points
    image[:, :120] = 0.0
    assert observe(image, CAMERA, config, device="cpu").count > 0.6 * min(points, 4800)


def test_given_poses_stand_in_for_tracking(device):
    given = GivenPoses(CONFIG, CAMERA, device=device)
    trackable = TrackableMap(TrackableConfig(), device=device)
    first = given.start(frame(0), pose(0))
    assert first.overlap == 0.0 and trackable.add(first.points, first.T_wc) == len(first.points.points)
    result = given.track(frame(1, T_wc=pose(1)), trackable.snapshot())
    np.testing.assert_array_equal(result.T_wc, pose(1))
    assert result.verdict is Verdict.CONVERGED and result.overlap > 0.8
    untold = given.track(frame(2), trackable.snapshot())
    assert untold.verdict is Verdict.CONVERGED and error(untold, 2)[0] < 1e-3


def test_every_option_is_documented():
    import inspect

    for config in (GicpConfig, ObservationConfig, TrackableConfig):
        source = inspect.getsource(config)
        assert source.count('"""') >= 2 * (len(inspect.get_annotations(config)) + 1)
