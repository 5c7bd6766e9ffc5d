# SPDX-License-Identifier: Apache-2.0
"""Frames that the map could do without, as long as the next keyframe came."""

from __future__ import annotations

from collections import deque

from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float64, Frame

_MOST = 4
"""A mapping keyframe is due as often, unless policies are told otherwise."""


class PassedOver(Stateful):
    """The frames of use since the last keyframe, which became none.

    Each shows a strip that the keyframe before it does not; the one after it would show that, too. Where the
    pictures after it are of no use, it is the last that does.
    """

    STATE = ("_frames",)

    def __init__(self) -> None:
        """Begin without any."""
        self._frames: deque[tuple[Frame, Float64]] = deque(maxlen=_MOST)

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, frame: Frame, T_wc: Float64) -> None:
        """Keep ``frame``, tracked at ``T_wc`` [4, 4], and forget the oldest of too many."""
        self._frames.append((frame, T_wc))

    def pop(self) -> tuple[Frame, Float64]:
        """Return the newest frame and its pose, and keep it no more.

        Raises:
            IndexError: there is none.
        """
        return self._frames.pop()

    def clear(self) -> None:
        """Forget all of them: there is a new keyframe."""
        self._frames.clear()

    def move(self, correction: PoseCorrection) -> None:
        """Let them follow a closed loop."""
        motions = correction.at([frame.index for frame, _ in self._frames])
        for place, (frame, T_wc) in enumerate(self._frames):
            self._frames[place] = frame, motions[place] @ T_wc
