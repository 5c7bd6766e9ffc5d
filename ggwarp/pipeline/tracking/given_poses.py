# SPDX-License-Identifier: Apache-2.0
"""A tracker that is told the poses: mapping alone, for comparison."""

from __future__ import annotations

from ggwarp.pipeline.tracking.gicp import GicpTracker
from ggwarp.types import Frame, MapSnapshot, TrackResult


class GivenPoses(GicpTracker):
    """Takes ``Frame.T_wc`` as the pose, and the overlap there; tracks frames that have none.

    Loops stay open: the poses are right.
    """

    on_map_moved = None  # pyright: ignore[reportAssignmentType]

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the frame's own pose, or the registered one where it has none."""
        if frame.T_wc is None:
            return super().track(frame, target)
        return self.place(frame, target, frame.T_wc)
