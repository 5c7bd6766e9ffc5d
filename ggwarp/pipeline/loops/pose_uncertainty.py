# SPDX-License-Identifier: Apache-2.0
"""How uncertain the camera's position is, counted from the first frame: drift as the run itself sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggwarp.geometry import se3
from ggwarp.pipeline.loops.loop_closer import Closure
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float64, TrackResult, Verdict

_ACCURACY = 0.02
"""Standard deviation of a depth sensor's scale: distances are wrong by one share, which no registration sees.
RealSense's D400 series states 2 % at most; Kinects of the TUM benchmark were 0, 3.1 and 3.5 % off."""

_UNFIXED = 0.02
"""What no registration fixes is held by the motion before: standard deviation, metres and radians."""


@state_value
@dataclass(frozen=True)
class _Keyframe:
    """A frame that later ones are registered to: [4, 4] its pose, and [6, 6] covariance in its camera."""

    index: int
    T_wc: Float64
    covariance: Float64


class PoseUncertainty(Stateful):
    """Adds up what registrations leave open, from keyframe to keyframe, and what the sensor's scale does.

    A frame is as uncertain as the last keyframe, whose points it was registered to, and by its own
    registration; standing still adds nothing. A closed loop leaves it as uncertain as the frame that it was
    closed with.
    """

    STATE = ("_keyframes",)

    def __init__(self) -> None:
        """Know nothing yet: the first frame is certain."""
        self._keyframes: list[_Keyframe] = []

    def position_std(
        self, index: int, result: TrackResult, *, is_keyframe: bool, closure: Closure | None = None
    ) -> float:
        """Return the largest standard deviation of a frame's position, metres; nan where none is known.

        Args:
            index: of the frame; frames come in order.
            result: its pose, as corrected, and what its registration says of it.
            is_keyframe: later frames will be registered to it.
            closure: the loop that it closed.
        """
        if not self._keyframes and result.verdict is Verdict.LOST:
            return float("nan")  # the first frame is still to come
        if not self._keyframes:
            self._keyframes.append(_Keyframe(index, result.T_wc, np.zeros((6, 6))))
            return 0.0
        last = self._keyframes[-1]
        if closure is not None:
            last = self._follow(closure)
        if result.information is None:
            return float("nan")
        own = np.linalg.inv(result.information + np.eye(6) / _UNFIXED**2)
        passed_on = se3.adjoint(se3.inverse(result.T_wc) @ last.T_wc)
        covariance = passed_on @ last.covariance @ passed_on.T + own
        if is_keyframe or closure is not None:
            self._keyframes.append(_Keyframe(index, result.T_wc, covariance))
        off = _scale_deviation(result) * np.linalg.norm(result.T_wc[:3, 3] - self._keyframes[0].T_wc[:3, 3])
        return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1] + off**2))

    def _follow(self, closure: Closure) -> _Keyframe:
        """Move the keyframes with a closed loop; return the last one before its earlier end."""
        motions = closure.correction.at([k.index for k in self._keyframes])
        self._keyframes = [
            _Keyframe(k.index, se3.orthonormalised(motion @ k.T_wc), k.covariance)
            for k, motion in zip(self._keyframes, motions, strict=True)
        ]
        if closure.seen_before is None:
            return self._keyframes[-1]
        before = [k for k in self._keyframes if k.index <= closure.seen_before]
        return before[-1] if before else self._keyframes[0]


def _scale_deviation(result: TrackResult) -> float:
    """Return the standard deviation of distances, as a share: none where depth has no sensor's noise."""
    noise_share = 0.0 if result.points is None else result.points.noise_share
    return _ACCURACY * min(noise_share, 1.0) ** 2
