# SPDX-License-Identifier: Apache-2.0
"""What of a run follows when a loop is closed; the loop itself is made up."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.pipeline.loops import loop_closer, tracking_side
from ggwarp.pipeline.loops.loop_closer import Closure
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.runner import run_steps
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.types import Verdict

OFFICE = SyntheticOffice(scale=0.15)
CONFIG = SlamConfig(mapper=MapperConfig(iterations=2))
MOTION = se3.se3_exp([0.05, -0.03, 0.02, 0.0, 0.1, 0.0])
CLOSING = 3


@pytest.fixture(scope="module")
def frames():
    return [OFFICE[i] for i in range(6)]


@pytest.fixture
def closing(monkeypatch):
    """Every run closes a loop at frame 3, which moves frames from 2 on by MOTION."""

    def observe(self, frame, result, scope):
        if frame.index != CLOSING:
            return None
        correction = PoseCorrection((0, 1, 2), np.stack([np.eye(4), np.eye(4), MOTION]))
        return Closure(correction, frame.index, 0, 0.06, 0.0)

    monkeypatch.setattr(loop_closer.LoopCloser, "observe", observe)
    monkeypatch.setattr(tracking_side, "solver_is_there", lambda: True)


def run(frames, config=CONFIG, *, concurrent=False):
    slam = Slam(config, OFFICE.camera, OFFICE.camera)
    reports = [report for _, report in run_steps(slam, iter(frames), concurrent=concurrent)]
    return slam, reports


def test_trajectory_tracking_and_map_follow(frames, closing):
    slam, reports = run(frames)
    assert slam.counts["loops_closed"] == 1
    assert reports[CLOSING].loop_with == 0 and reports[CLOSING].loop_moved_cm == pytest.approx(6.0)
    assert all(r.loop_with is None for r in reports if r.index != CLOSING)
    assert all(r.verdict is not Verdict.LOST for r in reports)
    final = slam.fitted_poses()
    for report, frame in zip(reports, frames, strict=True):
        moved = MOTION if report.index >= 2 else np.eye(4)
        error = se3.se3_log(se3.inverse(moved @ frame.T_wc) @ final[report.index])
        assert np.abs(error).max() < 0.01, report.index
        as_tracked = MOTION if report.index >= CLOSING else np.eye(4)
        error = se3.se3_log(se3.inverse(as_tracked @ frame.T_wc) @ report.T_wc)
        assert np.abs(error).max() < 0.01, report.index


def test_two_threads_give_the_same_bits(frames, closing):
    one, other = run(frames), run(frames, concurrent=True)
    for a, b in zip(one[1], other[1], strict=True):
        np.testing.assert_array_equal(a.T_wc, b.T_wc)
    for name, pose in one[0].fitted_poses().items():
        np.testing.assert_array_equal(pose, other[0].fitted_poses()[name])
    np.testing.assert_array_equal(one[0].map_arrays().means, other[0].map_arrays().means)


def test_a_loop_that_the_map_did_not_see_moves_it_all_the_same(frames, closing):
    """The run ends between a frame's tracking and its mapping."""
    slam = Slam(CONFIG, OFFICE.camera, OFFICE.camera)
    for frame in frames[:CLOSING]:
        slam.step(frame)
    before, means = slam.fitted_poses()[2], slam.map_arrays().means
    slam.leave_unmapped(slam.track_frame(frames[CLOSING]))
    np.testing.assert_allclose(slam.fitted_poses()[2], MOTION @ before, atol=1e-9)
    assert (slam.map_arrays().means != means).any()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"loops": False}, "--no-loops"),
        ({"tracker": "ground-truth"}, "no points that could be moved"),
        ({}, "gtsam"),
    ],
)
def test_loops_that_stay_open_say_why(frames, monkeypatch, change, reason):
    monkeypatch.setattr(tracking_side, "solver_is_there", lambda: False)
    slam, reports = run(frames[:2], dataclasses.replace(CONFIG, **change))
    assert reason in slam.loops.stay_open and reports[1].loop_ms == 0.0
