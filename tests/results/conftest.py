# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from ggwarp.results.record import RunRecord
from ggwarp.types import StepReport, Verdict


def _pose(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def _step(index: int, x: float, verdict: Verdict = Verdict.CONVERGED, loss: float = 0.5) -> StepReport:
    return StepReport(
        index, index / 30, _pose(x), verdict, "", 0.9, 0.001, "", 10.0, 30.0, 4, 100, loss,
        latency_ms=10.0 * (1 + index), late_ms=max(0.0, 10.0 * (index - 1)), frames_behind=index // 2,
    )  # fmt: skip


@pytest.fixture
def record() -> RunRecord:
    """Three of four frames, one of them without a true pose."""
    return RunRecord(
        "office",
        "synthetic",
        "cpu",
        reports=[_step(0, 0.0), _step(2, 0.1), _step(3, 0.2, Verdict.LOST, float("nan"))],
        truth={0: _pose(0.0), 3: _pose(0.24)},
        skipped={1: "frame000001.jpg: damaged"},
        counts={"tracking_keyframes": 1, "mapping_keyframes": 1, "frames_lost": 1},
        loop_s=1.5,
    )
