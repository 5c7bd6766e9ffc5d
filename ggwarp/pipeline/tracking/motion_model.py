# SPDX-License-Identifier: Apache-2.0
"""The camera's motion as a tracker knows it: the last good pose, and the velocity there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggwarp.geometry import se3, sim3
from ggwarp.runtime.state import state_value
from ggwarp.types import Float64, Frame


@state_value
@dataclass
class MotionModel:
    """Constant velocity from the last good pose on.

    Attributes:
        T_wc: [4, 4] camera-to-world at ``time``, seconds.
        velocity: [6] (v, w) a second, in the camera.
        lost: frames lost since.
    """

    T_wc: Float64
    time: float
    velocity: Float64
    lost: int = 0

    @classmethod
    def at_rest(cls, T_wc: Float64, time: float) -> MotionModel:
        """Return no motion at all."""
        return cls(np.array(T_wc, np.float64), time, np.zeros(6))

    def predict(self, time: float) -> Float64:
        """Return the pose at ``time`` by constant velocity; that is trusted for one lost frame only."""
        if self.lost > 1:
            return self.T_wc
        return self.T_wc @ se3.se3_exp(self.velocity * (time - self.time))

    def to_colour(self, frame: Frame) -> Float64:
        """Return the motion [4, 4] from the camera of the frame's depth to that of its colour."""
        gap = frame.timestamp - depth_time(frame)
        return se3.se3_exp(self.velocity * gap) if gap else np.eye(4)

    def updated(self, T_wc: Float64, time: float) -> MotionModel:
        """Return the motion after a good frame at ``T_wc``."""
        dt = time - self.time
        velocity = se3.se3_log(se3.inverse(self.T_wc) @ T_wc) / dt if dt > 0.0 else np.zeros(6)
        return MotionModel(T_wc, time, velocity)

    def move(self, motion: Float64) -> None:
        """Let the pose go with the world, and the velocity with its scale, that ``motion`` [4, 4] changes."""
        self.T_wc = sim3.moved_pose(motion, self.T_wc)
        self.velocity[:3] *= sim3.split(motion)[1]

    def jump(self, T_wc: Float64, predicted: Float64, max_distance: float, max_turn: float) -> str:
        """Say how far ``T_wc`` is from the ``predicted`` pose, where that is farther than is likely.

        Args:
            max_distance, max_turn: metres and radians; as much again for each frame lost before.
        """
        allowed = 1 + self.lost
        motion = se3.se3_log(se3.inverse(predicted) @ T_wc)
        distance, turn = float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))
        if distance <= allowed * max_distance and turn <= allowed * max_turn:
            return ""
        return f"jump of {distance:.2f} m, {np.degrees(turn):.0f} degrees"


def depth_time(frame: Frame) -> float:
    """Return when the frame's depth was taken, seconds."""
    return frame.timestamp if frame.depth_timestamp is None else frame.depth_timestamp
