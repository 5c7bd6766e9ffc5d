# SPDX-License-Identifier: Apache-2.0
"""The trajectory as it is known now: frames follow their keyframes when a loop is closed."""

from __future__ import annotations

from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float64


class EstimatedPoses(Stateful):
    """Frames and where they were.

    Attributes:
        by_frame: frame -> its pose T_wc [4, 4].
    """

    STATE = ("by_frame",)

    def __init__(self) -> None:
        self.by_frame: dict[int, Float64] = {}

    def move(self, correction: PoseCorrection) -> None:
        """Let all poses follow their keyframes."""
        motions = correction.at(list(self.by_frame))
        for (index, T_wc), motion in zip(self.by_frame.items(), motions, strict=True):
            self.by_frame[index] = se3.orthonormalised(motion @ T_wc)
