# SPDX-License-Identifier: Apache-2.0
import numpy as np

from ggwarp.map.covisibility import Visibility
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig, keyframes_that_leave, unconfirmed
from ggwarp.types import Float64

CONFIG = WindowConfig(size=4, cutoff=0.4)


def at(x: float) -> Float64:
    T = np.eye(4)
    T[0, 3] = x
    return T


def look(T_wc: Float64) -> Visibility:
    """A corridor of 100 Gaussians to the metre, of which one metre is in view, one metre away."""
    centres = (np.arange(1000) + 0.5) / 100.0
    return Visibility(np.abs(centres - 5.0 - T_wc[0, 3]) < 0.5, 1.0)


def test_keyframes_leave_that_share_too_little_with_the_newest() -> None:
    # Overlap with the newest: 0.3 (leaves), 0.5 (stays).
    assert keyframes_that_leave([at(0.0), at(0.2), at(0.65), at(0.7)], CONFIG, look) == [0]


def test_the_newest_two_stay_whatever_they_share() -> None:
    assert keyframes_that_leave([at(0.0), at(3.0)], CONFIG, look) == []
    assert keyframes_that_leave([at(0.0), at(3.0), at(6.0)], CONFIG, look) == [0]


def test_a_window_that_is_too_full_loses_its_most_crowded_keyframe() -> None:
    poses = [at(0.0), at(0.20), at(0.21), at(0.4), at(0.5)]
    # sqrt(d_0) sum 1 / d_j: 1 and 2 are crowded, and 1 is the farther one from the newest.
    assert keyframes_that_leave(poses, CONFIG, look) == [1]
    assert keyframes_that_leave(poses[1:], CONFIG, look) == []


def test_gaussians_of_late_are_dropped_unless_other_keyframes_see_them() -> None:
    keyframe_ids = np.array([0, 3, 3, 5, 5, 6, 6, 7, 7], np.int32)
    visible = {
        0: [0, 0, 0, 0, 0, 0, 1, 0, 0],
        3: [0, 1, 0, 0, 0, 0, 1, 0, 0],
        5: [0, 1, 0, 1, 1, 0, 1, 0, 0],
        6: [0, 1, 0, 0, 1, 1, 1, 0, 0],
        7: [0, 1, 1, 0, 1, 0, 0, 1, 1],
    }
    seen = {number: np.array(row, bool) for number, row in visible.items()}
    gone = unconfirmed(keyframe_ids, seen, 2)
    # Old ones passed, the newest's have not had their chance; a keyframe does not confirm its own.
    assert gone.tolist() == [False, False, True, True, False, True, False, False, False]
    assert not unconfirmed(keyframe_ids, seen, 0).any()
