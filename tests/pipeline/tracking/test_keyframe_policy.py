# SPDX-License-Identifier: Apache-2.0
import numpy as np

from ggwarp.pipeline.tracking.keyframe_policy import KeyframeConfig, KeyframeKind, OverlapKeyframes
from ggwarp.types import TrackResult, Verdict

CONFIG = KeyframeConfig(overlap=0.7, mapping_interval=3)


def result(overlap: float, verdict: Verdict = Verdict.CONVERGED) -> TrackResult:
    return TrackResult(np.eye(4), verdict, overlap=overlap)


def test_the_first_frame_is_a_tracking_keyframe() -> None:
    policy = OverlapKeyframes(CONFIG)
    assert policy.empty
    assert policy.decide(result(0.0)) is KeyframeKind.TRACKING
    assert not policy.empty


def test_low_overlap_makes_a_tracking_keyframe_and_restarts_the_interval() -> None:
    policy = OverlapKeyframes(CONFIG)
    kinds = [policy.decide(result(overlap)) for overlap in (1, 0.9, 0.9, 0.6, 0.9, 0.9, 0.9, 0.9)]
    assert [kind.value for kind in kinds] == ["tracking", "", "", "tracking", "", "", "mapping", ""]


def test_a_lost_frame_never_enters_the_map() -> None:
    policy = OverlapKeyframes(CONFIG)
    policy.decide(result(1.0))
    assert policy.decide(result(0.0, Verdict.LOST)) is KeyframeKind.NONE
