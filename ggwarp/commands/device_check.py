# SPDX-License-Identifier: Apache-2.0
"""Whether a GPU computes what the CPU does, to how many digits, and how fast: ``ggwarp doctor --gpu``.

The first frames of the built-in office are tracked and mapped on both devices, and compared. A run is a
long chain of sums that devices add up in different orders: last digits differ, and grow. What is right
agrees within the limits of :data:`LIMITS` all the same.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.datasets import BadFrame, FrameReader, SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.pipeline.slam import Slam
from ggwarp.pipeline.slam_config import SlamConfig
from ggwarp.types import Frame, Rendered, StepReport

FRAMES = 6
SCALE = 0.25
_TIMED = 50
"""Mapping iterations."""

LIMITS = {
    "poses, mm": 1.0,
    "depth, mm": 5.0,
    "colours, dB": 35.0,
    "objects, % of pixels": 10.0,
    "Gaussians, %": 2.0,
}
"""What may differ, at most; of the decibels, which say how alike two pictures are, at least. A tracked
frame is off by 0.1 mm, a map of so few frames shows an object's border a pixel aside."""


@dataclass(frozen=True)
class Agreement:
    """How two devices agree on one thing; ``found`` is within ``limit`` where they do."""

    what: str
    found: float
    limit: float

    @property
    def good(self) -> bool:
        """Whether they agree; what is not finite does not."""
        alike = self.found >= self.limit if self.what.endswith("dB") else self.found <= self.limit
        return bool(np.isfinite(self.found)) and alike


@dataclass(frozen=True)
class DeviceRun:
    """What a device made of the frames, and how long it took.

    Attributes:
        reports: of the frames. view: the map from the last one's pose.
        frame_ms, iteration_ms: wall time of a whole frame, the first two aside, and of a mapping iteration.
    """

    reports: list[StepReport]
    view: Rendered
    frame_ms: float
    iteration_ms: float


def check_devices(device: Any, reference: Any = "cpu") -> Iterator[Agreement | DeviceRun]:
    """Yield how ``device`` agrees with ``reference``, and last what each did."""
    frames = office_frames()
    one, other = (run_on(d, frames) for d in (reference, device))
    yield from agreements(one, other)
    yield from (one, other)


def office_frames() -> list[Frame]:
    """Return the first frames of the built-in office."""
    with FrameReader(SyntheticOffice(frames=120, scale=SCALE), range(FRAMES), scale=1.0) as reader:
        return [frame for frame in reader if not isinstance(frame, BadFrame)]


def run_on(device: Any, frames: list[Frame]) -> DeviceRun:
    """Track and map ``frames`` on ``device``."""
    camera = SyntheticOffice(frames=120, scale=SCALE).camera
    slam = Slam(SlamConfig(), camera, camera, device=device)
    reports, seconds = [], []
    for frame in frames:
        started = time.perf_counter()
        reports.append(slam.step(frame))
        wp.synchronize_device(device)
        seconds.append(time.perf_counter() - started)
    view = slam.render(reports[-1].T_wc)
    started = time.perf_counter()
    for _ in range(_TIMED):
        slam.refine()
    iteration = (time.perf_counter() - started) / _TIMED
    return DeviceRun(reports, view, 1e3 * float(np.median(seconds[2:])), 1e3 * iteration)


def agreements(one: DeviceRun, other: DeviceRun) -> Iterator[Agreement]:
    """Yield how two runs of the same frames agree."""
    motions = [se3.inverse(a.T_wc) @ b.T_wc for a, b in zip(one.reports, other.reports, strict=True)]
    error = np.mean((one.view.rgb - other.view.rgb).astype(np.float64) ** 2)
    both = (one.view.opacity > 0.5) & (other.view.opacity > 0.5)
    depth = np.abs(one.view.median_depth - other.view.median_depth)[both]
    counts = [run.reports[-1].gaussians for run in (one, other)]
    found = {
        "poses, mm": 1e3 * max(float(np.linalg.norm(T[:3, 3])) for T in motions),
        "depth, mm": 1e3 * float(np.median(depth)) if depth.size else np.nan,
        "colours, dB": float(-10.0 * np.log10(max(error, 1e-12))),
        "objects, % of pixels": 100.0 * float(np.mean(one.view.objects != other.view.objects)),
        "Gaussians, %": 100.0 * abs(counts[0] - counts[1]) / max(counts[0], 1),
    }
    for what, value in found.items():
        yield Agreement(what, value, LIMITS[what])
