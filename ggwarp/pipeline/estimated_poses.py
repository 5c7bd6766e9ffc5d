# SPDX-License-Identifier: Apache-2.0
"""The trajectory as it is known now: frames follow their keyframes when a loop is closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float64, StepReport, Verdict


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
        self.by_frame = correction.moved(self.by_frame)

    def final(self, reports: Sequence[StepReport], later: Mapping[int, Float64]) -> dict[int, Float64]:
        """Return the pose of each frame by all that is known by now.

        A lost frame between two that were tracked is interpolated by its time: what was predicted for it
        stayed where the camera was lost. Before the first and after the last tracked one it stays so.

        Args:
            reports: of the frames, in their order.
            later: frame -> pose that became known after it was reported.
        """
        poses, lost = self.by_frame | dict(later), []
        before: StepReport | None = None
        for report in reports:
            if report.verdict is Verdict.LOST and report.index not in later:
                lost.append(report)
                continue
            if before is not None:
                poses |= _between(before, report, lost, poses)
            before, lost = report, []
        return poses


def _between(
    begin: StepReport, end: StepReport, lost: Sequence[StepReport], poses: Mapping[int, Float64]
) -> dict[int, Float64]:
    """Return the pose of each ``lost`` frame on the way from that of ``begin`` to that of ``end``."""
    T_begin, T_end, seconds = poses[begin.index], poses[end.index], end.timestamp - begin.timestamp
    shares = {r.index: (r.timestamp - begin.timestamp) / seconds for r in lost} if seconds > 0.0 else {}
    return {i: se3.interpolate(T_begin, T_end, share) for i, share in shares.items() if 0.0 < share < 1.0}
