# SPDX-License-Identifier: Apache-2.0
"""What a run gathers on its way."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

from ggwarp.evaluation.evaluate import Evaluation
from ggwarp.types import Float64, StepReport


@dataclass
class RunRecord:
    """What a run gathers on its way, the map itself aside.

    Attributes:
        sequence: its name. dataset: its kind. device: "cpu" or "cuda:N".
        reports: one a processed frame, in order.
        live: index -> [4, 4] pose of each frame as it was reported; empty until poses are corrected.
        truth: index -> [4, 4] true camera-to-world pose, where known.
        monocular: whether the trajectory has no scale of its own.
        skipped: index -> why the frame could not be used.
        counts: tracking_keyframes, mapping_keyframes, frames_lost, and what the mapper left out.
        class_names: mask id -> what the object is, where the data says.
        loop_s: seconds from the first frame's arrival to the last one's end.
        refine_iterations, refine_s: spent on the map after the last frame.
        interrupted: whether a signal ended the run before its frames or its comparison were done.
        failure: what ended the run early; None: nothing did.
        failures: one line for each part of the run that failed, ``failure`` included, in order.
        warnings: what the user was warned of, as far as it was saved, in order.
        plan: how the sequence was read, as ``metrics.json`` has it.
        evaluation: pictures and objects against the frames; empty when not done.
    """

    sequence: str
    dataset: str
    device: str
    reports: list[StepReport] = field(default_factory=list)
    live: dict[int, Float64] = field(default_factory=dict)
    truth: dict[int, Float64] = field(default_factory=dict)
    skipped: dict[int, str] = field(default_factory=dict)
    monocular: bool = False
    counts: dict[str, int] = field(default_factory=dict)
    class_names: dict[int, str] = field(default_factory=dict)
    loop_s: float = 0.0
    refine_iterations: int = 0
    refine_s: float = 0.0
    interrupted: bool = False
    failure: Exception | None = None
    failures: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    plan: dict[str, Any] = field(default_factory=dict)
    evaluation: Evaluation = field(default_factory=Evaluation)

    def poses(self) -> dict[int, Float64]:
        """Return index -> [4, 4] estimated camera-to-world pose."""
        return {r.index: r.T_wc for r in self.reports}

    def correct(self, poses: dict[int, Float64], mapped: Collection[int] = ()) -> None:
        """Take in what became known of frames after they were reported.

        Args:
            poses: index -> [4, 4] pose to replace the one that was reported.
            mapped: frames in the map; those that were reported as none became keyframes later.
        """
        self.live = self.live or self.poses()
        late = {r.index for r in self.reports if not r.keyframe}.intersection(mapped)
        if late:
            self.counts["mapping_keyframes"] = self.counts.get("mapping_keyframes", 0) + len(late)
        self.reports = [
            replace(
                r,
                T_wc=poses.get(r.index, r.T_wc),
                keyframe="mapping" if r.index in late else r.keyframe,
            )
            for r in self.reports
        ]
