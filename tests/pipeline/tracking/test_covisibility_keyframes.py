# SPDX-License-Identifier: Apache-2.0
import numpy as np

from ggwarp.map.covisibility import Visibility
from ggwarp.pipeline.tracking.keyframe_policy import CovisibilityConfig, CovisibilityKeyframes, KeyframeKind
from ggwarp.types import Float64, FramePoints, TrackResult, Verdict

CONFIG = CovisibilityConfig(interval=2, overlap=0.9, min_translation=0.02, translation=0.2)
POINTS = FramePoints(*(np.zeros((1, n), np.float32) for n in (3, 4, 3)), *np.zeros((2, 1), np.float32))


def at(x: float) -> Float64:
    T = np.eye(4)
    T[0, 3] = x
    return T


def look(T_wc: Float64) -> Visibility:
    """A corridor of 100 Gaussians to the metre, of which one metre is in view, one metre away."""
    centres = (np.arange(1000) + 0.5) / 100.0
    return Visibility(np.abs(centres - 5.0 - T_wc[0, 3]) < 0.5, 1.0)


def result(x: float, verdict: Verdict = Verdict.CONVERGED, points: bool = True) -> TrackResult:
    return TrackResult(at(x), verdict, points=POINTS if points else None)


def kinds(*results: TrackResult) -> list[str]:
    policy = CovisibilityKeyframes(CONFIG, look)
    return [policy.decide(r).value for r in results]


def test_a_frame_that_sees_something_new_is_a_keyframe() -> None:
    # IoU of views 0.1 m apart: 0.9 / 1.1 < 0.9; of views 0.03 m apart: 0.97 / 1.03 > 0.9.
    assert kinds(result(0.0), result(0.0), result(0.03), result(0.1)) == ["tracking", "", "", "tracking"]


def test_a_keyframe_waits_for_its_interval() -> None:
    assert kinds(result(0.0), result(0.5), result(0.5)) == ["tracking", "", "tracking"]


def test_far_is_enough_and_near_is_not() -> None:
    class Blind:
        def __call__(self, T_wc: Float64) -> Visibility:
            return Visibility(np.ones(1, bool), 1.0)  # everything sees the same

    policy = CovisibilityKeyframes(CONFIG, Blind())
    found = [policy.decide(result(x)).value for x in (0.0, 0.0, 0.19, 0.21)]
    assert found == ["tracking", "", "", "tracking"]


def test_a_lost_frame_never_enters_and_one_without_depth_adds_no_points() -> None:
    assert kinds(result(0.0, Verdict.LOST), result(0.0, points=False)) == ["", "mapping"]


def test_a_frame_that_sees_nothing_of_the_map_is_a_keyframe() -> None:
    policy = CovisibilityKeyframes(CONFIG, lambda T: Visibility(np.zeros(3, bool), float("nan")))
    assert [policy.decide(result(x)).value for x in (0.0, 0.0, 0.0)] == ["tracking", "", "tracking"]
    assert policy.decide(result(0.0)) is KeyframeKind.NONE, "not before its interval"
