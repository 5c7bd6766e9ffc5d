# SPDX-License-Identifier: Apache-2.0
import numpy as np

from ggwarp.map.covisibility import Sight, intersection_over_union, overlap_coefficient
from ggwarp.pipeline.keyframes import KeyframeKind
from ggwarp.pipeline.window import CovisibilityKeyframes, WindowConfig, leavers, unconfirmed
from ggwarp.types import Float64, TrackResult, Verdict

CONFIG = WindowConfig(interval=2, overlap=0.9, min_translation=0.02, translation=0.2, size=4, cutoff=0.4)


def at(x: float) -> Float64:
    T = np.eye(4)
    T[0, 3] = x
    return T


def look(T_wc: Float64) -> Sight:
    """A corridor of 100 Gaussians to the metre, of which one metre is in view, one metre away."""
    centres = (np.arange(1000) + 0.5) / 100.0
    return Sight(np.abs(centres - 5.0 - T_wc[0, 3]) < 0.5, 1.0)


def result(x: float, verdict: Verdict = Verdict.CONVERGED, points: bool = True) -> TrackResult:
    return TrackResult(at(x), verdict, points=np.zeros((1, 3), np.float32) if points else None)


def kinds(*results: TrackResult) -> list[str]:
    policy = CovisibilityKeyframes(CONFIG, look)
    return [policy.decide(r).value for r in results]


def test_sets() -> None:
    a, b = np.array([1, 1, 1, 0, 0], bool), np.array([0, 1, 1, 1, 1], bool)
    assert intersection_over_union(a, b) == 2 / 5
    assert overlap_coefficient(a, b) == 2 / 3
    nothing = np.zeros(5, bool)
    assert intersection_over_union(nothing, nothing) == 0.0
    assert overlap_coefficient(a, nothing) == 0.0


def test_a_frame_that_sees_something_new_is_a_keyframe() -> None:
    # IoU of views 0.1 m apart: 0.9 / 1.1 < 0.9; of views 0.03 m apart: 0.97 / 1.03 > 0.9.
    assert kinds(result(0.0), result(0.0), result(0.03), result(0.1)) == ["tracking", "", "", "tracking"]


def test_a_keyframe_waits_for_its_interval() -> None:
    assert kinds(result(0.0), result(0.5), result(0.5)) == ["tracking", "", "tracking"]


def test_far_is_enough_and_near_is_not() -> None:
    class Blind:
        def __call__(self, T_wc: Float64) -> Sight:
            return Sight(np.ones(1, bool), 1.0)  # everything sees the same

    policy = CovisibilityKeyframes(CONFIG, Blind())
    found = [policy.decide(result(x)).value for x in (0.0, 0.0, 0.19, 0.21)]
    assert found == ["tracking", "", "", "tracking"]


def test_a_lost_frame_never_enters_and_one_without_depth_adds_no_points() -> None:
    assert kinds(result(0.0, Verdict.LOST), result(0.0, points=False)) == ["", "mapping"]


def test_a_frame_that_sees_nothing_of_the_map_is_a_keyframe() -> None:
    policy = CovisibilityKeyframes(CONFIG, lambda T: Sight(np.zeros(3, bool), float("nan")))
    assert [policy.decide(result(x)).value for x in (0.0, 0.0, 0.0)] == ["tracking", "", "tracking"]
    assert policy.decide(result(0.0)) is KeyframeKind.NONE, "not before its interval"


def test_keyframes_leave_that_share_too_little_with_the_newest() -> None:
    # Overlap with the newest: 0.3 (leaves), 0.5 (stays).
    assert leavers([at(0.0), at(0.2), at(0.65), at(0.7)], CONFIG, look) == [0]


def test_the_newest_two_stay_whatever_they_share() -> None:
    assert leavers([at(0.0), at(3.0)], CONFIG, look) == []
    assert leavers([at(0.0), at(3.0), at(6.0)], CONFIG, look) == [0]


def test_a_window_that_is_too_full_loses_its_most_crowded_keyframe() -> None:
    poses = [at(0.0), at(0.20), at(0.21), at(0.4), at(0.5)]
    # sqrt(d_0) sum 1 / d_j: 1 and 2 are crowded, and 1 is the farther one from the newest.
    assert leavers(poses, CONFIG, look) == [1]
    assert leavers(poses[1:], CONFIG, look) == []


def test_gaussians_of_late_are_dropped_unless_other_keyframes_see_them() -> None:
    births = np.array([0, 3, 3, 5, 5, 6, 6, 7, 7], np.int32)
    sights = {
        0: [0, 0, 0, 0, 0, 0, 1, 0, 0],
        3: [0, 1, 0, 0, 0, 0, 1, 0, 0],
        5: [0, 1, 0, 1, 1, 0, 1, 0, 0],
        6: [0, 1, 0, 0, 1, 1, 1, 0, 0],
        7: [0, 1, 1, 0, 1, 0, 0, 1, 1],
    }
    seen = {number: np.array(row, bool) for number, row in sights.items()}
    gone = unconfirmed(births, seen, 2)
    # Old ones passed, the newest's have not had their chance; a keyframe does not confirm its own.
    assert gone.tolist() == [False, False, True, True, False, True, False, False, False]
    assert not unconfirmed(births, seen, 0).any()
