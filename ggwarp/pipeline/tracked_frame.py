# SPDX-License-Identifier: Apache-2.0
"""What goes from tracking to mapping: a frame, its pose and what it adds to the map."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ggwarp.pipeline.loops.loop_closer import Closure
from ggwarp.pipeline.scheduler import Arrival
from ggwarp.pipeline.tracking.keyframe_policy import KeyframeKind
from ggwarp.runtime.state import state_value
from ggwarp.types import Frame, StepReport, TrackResult, Verdict


@state_value
@dataclass(frozen=True)
class TrackedFrame:
    """A frame as the tracker's side hands it to the mapper's; everything is on the host.

    Attributes:
        frame: as it came. arrival: when that was.
        result: its pose. kind: what it adds to the map.
        seconds: spent on the pose.
        closure: the loop that it closes, if it does; ``result`` is as corrected.
        loop_seconds: of ``seconds``, spent on looking for loops.
    """

    frame: Frame
    arrival: Arrival
    result: TrackResult
    kind: KeyframeKind
    seconds: float
    closure: Closure | None = None
    loop_seconds: float = 0.0

    @property
    def loop(self) -> Closure | None:
        """The closure, if a place was seen again."""
        return self.closure if self.closure is not None and self.closure.seen_before is not None else None

    @property
    def is_keyframe(self) -> bool:
        return self.kind is not KeyframeKind.NONE

    @property
    def is_lost(self) -> bool:
        return self.result.verdict is Verdict.LOST

    def mapped(self, added: bool) -> TrackedFrame:
        """Return the frame as the mapper took it: a keyframe if it was ``added``, else none."""
        if not added:
            return replace(self, kind=KeyframeKind.NONE)
        return self if self.is_keyframe else replace(self, kind=KeyframeKind.MAPPING)

    def report(self, *, seconds: float, iterations: int, gaussians: int, loss: float) -> StepReport:
        """Return the frame's report.

        Args:
            seconds, iterations: spent on the map.
            gaussians: in the map afterwards.
            loss: mean mapping loss.
        """
        result, arrival = self.result, self.arrival
        return StepReport(
            index=self.frame.index,
            timestamp=self.frame.timestamp,
            T_wc=result.T_wc,
            verdict=result.verdict,
            reason=result.reason,
            overlap=result.overlap,
            rmse=0.0 if result.points is None else result.points.rmse,
            depth_noise_mm=0.0 if result.points is None else 1e3 * result.points.typical_noise,
            position_std_cm=100.0 * result.position_std,
            keyframe=self.kind.value,
            tracking_ms=1e3 * self.seconds,
            mapping_ms=1e3 * seconds,
            mapping_iterations=iterations,
            gaussians=gaussians,
            loss=loss,
            latency_ms=1e3 * (arrival.delay + self.seconds),
            late_ms=1e3 * arrival.delay if arrival.late else 0.0,
            frames_behind=arrival.behind,
            loop_ms=1e3 * self.loop_seconds,
            loop_with=None if self.loop is None else self.loop.seen_before,
            loop_moved_cm=None if self.loop is None else 100.0 * self.loop.moved,
        )
