# SPDX-License-Identifier: Apache-2.0
"""How poses of a trajectory change when a loop is closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ggwarp.geometry import sim3
from ggwarp.geometry.se3 import Array


@dataclass(frozen=True)
class PoseCorrection:
    """Motions of the world, known at some frames and interpolated between them.

    What belongs to a frame moves as one: a pose T_wc becomes ``at(index) @ T_wc``, with its axes at length 1
    again where the motion has a scale. Before the first and after the last known frame their own motions
    hold.

    Attributes:
        indices: frames, rising.
        motions: [n, 4, 4] motion of the world at each: rigid, or a similarity where frames have no depth.
    """

    indices: tuple[int, ...]
    motions: Array

    def __post_init__(self) -> None:
        """Refuse what is no function of the frame, by ValueError."""
        if not self.indices or len(self.indices) != len(self.motions):
            raise ValueError(f"{len(self.indices)} frames, but {len(self.motions)} motions")
        if any(a >= b for a, b in zip(self.indices, self.indices[1:], strict=False)):
            raise ValueError("frames of a correction must rise")

    def at(self, indices: Sequence[int]) -> Array:
        """Return [n, 4, 4] the motions at frames ``indices``, in any order."""
        known, found = {}, np.empty((len(indices), 4, 4))
        for row, index in enumerate(indices):
            if index not in known:
                known[index] = self._at(index)
            found[row] = known[index]
        return found

    def moved(self, poses: Mapping[int, Array]) -> dict[int, Array]:
        """Return the poses T_wc [4, 4] of frames, by index, as they are after the correction."""
        motions = zip(poses.items(), self.at(list(poses)), strict=True)
        return {index: sim3.moved_pose(motion, T_wc) for (index, T_wc), motion in motions}

    def _at(self, index: int) -> Array:
        after = int(np.searchsorted(self.indices, index))
        if after == len(self.indices):
            return self.motions[-1]
        if after == 0 or self.indices[after] == index:
            return self.motions[after]
        before, begin, end = after - 1, self.indices[after - 1], self.indices[after]
        share = (index - begin) / (end - begin)
        return sim3.interpolate(self.motions[before], self.motions[after], share)
