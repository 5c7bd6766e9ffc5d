# SPDX-License-Identifier: Apache-2.0
"""What registrations leave open adds up along the way, and ends where a loop is closed."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.pipeline.loops.loop_closer import Closure
from ggwarp.pipeline.loops.pose_uncertainty import PoseUncertainty
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.types import FramePoints, TrackResult, Verdict

OFFICE = SyntheticOffice(scale=0.15)
SURE = np.diag([1e6] * 3 + [1e8] * 3)  # 1 mm and 0.1 mrad


def result(T_wc: np.ndarray, information: np.ndarray | None = SURE) -> TrackResult:
    return TrackResult(T_wc, Verdict.CONVERGED, information=information)


def moved(x: float) -> np.ndarray:
    return se3.se3_exp([x, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_the_first_frame_is_certain_and_standing_still_adds_nothing():
    known = PoseUncertainty()
    assert known.position_std(0, result(np.eye(4), None), is_keyframe=True) == 0.0
    first, *others = (known.position_std(i, result(np.eye(4)), is_keyframe=False) for i in range(1, 9))
    assert first == pytest.approx(1e-3, rel=0.01) and others == [first] * 7


def test_keyframes_add_up_as_a_random_walk_does():
    known = PoseUncertainty()
    known.position_std(0, result(np.eye(4), None), is_keyframe=True)
    stds = [known.position_std(i, result(np.eye(4)), is_keyframe=True) for i in range(1, 17)]
    assert stds[15] == pytest.approx(4.0 * stds[0], rel=1e-3)


def test_turns_that_are_unsure_count_by_how_far_the_camera_goes():
    # By 1 mrad about a vertical axis, and then 3 m are walked.
    loose = np.diag([1e12] * 3 + [1e12, 1.0 / 0.001**2, 1e12])
    known = PoseUncertainty()
    known.position_std(0, result(np.eye(4), None), is_keyframe=True)
    turn = known.position_std(1, result(np.eye(4), loose), is_keyframe=True)
    walked = known.position_std(2, result(moved(3.0), 1e6 * SURE), is_keyframe=True)
    assert turn < 1e-4 and walked == pytest.approx(0.001 * 3.0, rel=0.01)


@pytest.mark.parametrize("noise_share", [0.0, 0.1, 1.0, 1.4])
def test_a_real_sensors_scale_counts_by_the_distance_from_the_start(noise_share):
    """Rendered depth has none; coming back takes it away."""
    none = np.zeros((0, 3), np.float32)
    points = FramePoints(none, none, none, none[:, 0], none[:, 0], noise_share=noise_share)
    known = PoseUncertainty()
    known.position_std(0, result(moved(1.0), None), is_keyframe=True)
    there = (dataclasses.replace(result(moved(x), 1e9 * SURE), points=points) for x in (4.0, 1.0))
    away, back = (known.position_std(i, seen, is_keyframe=False) for i, seen in enumerate(there, 1))
    assert away == pytest.approx(0.02 * 3.0 * min(noise_share, 1.0) ** 2, rel=0.01, abs=1e-6)
    assert back < 1e-6


def test_what_nothing_fixes_is_centimetres_and_what_is_not_stated_is_not_known():
    known = PoseUncertainty()
    known.position_std(0, result(np.eye(4), None), is_keyframe=True)
    assert known.position_std(1, result(np.eye(4), np.zeros((6, 6))), is_keyframe=False) > 0.015
    assert np.isnan(known.position_std(2, result(np.eye(4), None), is_keyframe=True))


def test_a_closed_loop_takes_back_what_was_lost_since():
    known = PoseUncertainty()
    known.position_std(0, result(np.eye(4), None), is_keyframe=True)
    stds = [known.position_std(i, result(moved(0.1 * i)), is_keyframe=True) for i in range(1, 40)]
    correction = PoseCorrection((2, 40), np.stack([np.eye(4), moved(-0.2)]))
    closure = Closure(correction, frame=40, seen_before=2, moved=0.2, seconds=0.0)
    back = known.position_std(40, result(moved(0.2)), is_keyframe=False, closure=closure)
    assert stds[1] < back < 0.3 * stds[-1]
    assert known.position_std(41, result(moved(0.2)), is_keyframe=False) < 1.2 * back
    again = PoseUncertainty()
    again.restore(known.state(), lambda _: OFFICE[0])
    one, two = (k.position_std(42, result(moved(0.2)), is_keyframe=False) for k in (known, again))
    assert one == two


def test_a_run_says_it_of_every_frame():
    slam = Slam(SlamConfig(use_identity=False), OFFICE.camera, OFFICE.camera)
    reports = [slam.step(OFFICE[i]) for i in range(6)]
    stds = [r.position_std_cm for r in reports]
    assert stds[0] == 0.0 and all(0.0 < std < 1.0 for std in stds[1:])


def test_it_begins_with_the_first_frame_that_is_not_lost():
    known = PoseUncertainty()
    lost = TrackResult(moved(7.0), Verdict.LOST)
    assert np.isnan(known.position_std(0, lost, is_keyframe=False))
    assert known.position_std(1, result(np.eye(4), None), is_keyframe=True) == 0.0
