# SPDX-License-Identifier: Apache-2.0
"""``memory``: what grows while the same path is walked again and again: memory, map, the time of a frame."""

from __future__ import annotations

import dataclasses
import gc
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarking.endurance.walk import Walk
from benchmarking.options import BenchmarkError, Common, new_record
from benchmarking.record import Check, Record, Row, Section
from ggwarp.config import RunConfig, device_name, preset_config, resolve_config
from ggwarp.datasets import FrameReader, open_dataset
from ggwarp.map.submap import MapBudget
from ggwarp.pipeline.slam import Slam
from ggwarp.runtime.image_store import ImageStore
from ggwarp.types import Frame, StepReport

COURSE = "as the path is walked again"
_MOST_MB, _MOST_BOUNDED_MB, _MOST_GROWTH = 2000.0, 1000.0, 1.1
_ROWS = 40


@dataclass(frozen=True)
class MemoryOptions(Common):
    """One sequence, walked again and again: to and fro, or round where it ends as it began."""

    seq: str = "office"
    """The sequence."""
    frames: int = 2000
    """Frames to walk in all."""
    length: int | None = None
    """Walk over the sequence's first N frames alone; default: all."""
    preset: str = "fast"
    """The preset."""
    scale: float = 0.25
    """Image scale."""
    points: int | None = None
    """Points of a frame to track by; default: the preset's."""
    minutes: float | None = None
    """End after so long, wherever that is; default: at the end."""
    memory: float = 0.1
    """Gigabytes for keyframes' images."""
    map_memory: float | None = None
    """Gigabytes for the map; what of it is out of view goes to a file beyond them. Default: all stays."""
    data: Path | None = None
    """Data root; default: $GGWARP_DATA, else ./data."""


def run(options: MemoryOptions) -> Record:
    """Walk, and return the record.

    Raises:
        BenchmarkError: there is nothing to walk, or this system does not say what memory a process has.
    """
    record = new_record("memory", options)
    resident_mb()
    frames = min(options.frames, 200) if options.quick else options.frames
    dataset = open_dataset(options.seq, data_root=options.data or RunConfig().data_root())
    length = min(options.length or len(dataset), len(dataset))
    if frames < 1 or length < 3:
        raise BenchmarkError(f"--frames {frames} over {length} frames: give at least 1, over at least 3")
    walk = Walk(dataset, length=length, frames=frames)
    config = dataclasses.replace(preset_config(options.preset), device=device_name(options.device))
    config = resolve_config(dataclasses.replace(config, seq=options.seq, scale=options.scale), walk)
    if options.points is not None:
        gicp = dataclasses.replace(config.slam.gicp, points=options.points)
        config = dataclasses.replace(config, slam=dataclasses.replace(config.slam, gicp=gicp))
    size = options.map_memory
    map_budget = None if size is None else MapBudget(round(size * 1e9))
    end = math.inf if options.minutes is None else time.perf_counter() + 60.0 * options.minutes
    rows = walked(walk, config, budget=round(options.memory * 1e9), map_budget=map_budget, end=end)
    record.settings["image"] = f"{rows[-1].pop('width')}x{rows[-1].pop('height')}"
    record.sections.append(
        Section(
            COURSE,
            rows,
            f"after {walk.period} frames the camera is where it was; times are the process's CPU time, "
            "means since the row before, reading ahead included",
        )
    )
    record.checks += checks(rows, walk.period, most_mb=_MOST_MB if size is None else _MOST_BOUNDED_MB)
    return record


def walked(
    walk: Walk, config: RunConfig, *, budget: int, map_budget: MapBudget | None = None, end: float = math.inf
) -> list[Row]:
    """Return a row for every part of the walk until ``end``, the last with the images' size."""
    rows: list[Row] = []
    with FrameReader(walk, range(len(walk)), scale=config.scale or 1.0) as reader:
        store = ImageStore(device=config.device, budget=budget)
        stores: dict[str, Any] = {"images": store, "map_budget": map_budget}
        slam = Slam(config.slam, reader.camera, reader.sensor_camera, device=config.device, **stores)
        ends = {len(walk) * k // _ROWS for k in range(1, _ROWS + 1)}
        part, since = Part(), 0
        for frame in reader:
            if isinstance(frame, Frame):
                part.step(slam, frame)
            done = frame.index + 1
            if done in ends:
                rows.append(_row(slam, store, done) | part.row(done - since))
                part, since = Part(), done
                if time.perf_counter() > end:
                    break
        rows[-1] |= {"width": reader.camera.width, "height": reader.camera.height}
    return rows


@dataclass
class Part:
    """What a part of the walk took: CPU seconds, and how far positions were off at most, where known."""

    tracking: float = 0.0
    mapping: float = 0.0
    error_m: float | None = None

    def step(self, slam: Slam, frame: Frame) -> None:
        """Process a frame."""
        started = time.process_time()
        tracked = slam.track_frame(frame)
        between = time.process_time()
        slam.map_frame(tracked)
        self.tracking += between - started
        self.mapping += time.process_time() - between
        if frame.T_wc is not None:
            error = float(np.linalg.norm(tracked.result.T_wc[:3, 3] - frame.T_wc[:3, 3]))
            self.error_m = max(error, self.error_m or 0.0)

    def row(self, frames: int) -> Row:
        """Return its columns, times a frame."""
        return {
            "tracking ms": 1e3 * self.tracking / frames,
            "mapping ms": 1e3 * self.mapping / frames,
            "largest error mm": None if self.error_m is None else 1e3 * self.error_m,
        }


def _row(slam: Slam, store: ImageStore, frames: int) -> Row:
    gc.collect()
    last: StepReport = slam.reports[-1]
    return {
        "frames": frames,
        "resident MB": resident_mb(),
        "images in memory MB": store.held / 1e6,
        "in the file MB": store.stored / 1e6,
        "keyframes": len(slam.keyframe_indices),
        "Gaussians": last.gaussians,
        "Gaussians in memory": slam.map.count,
        "trackable points": len(slam._trackable),
        "loops": slam.counts["loops_closed"],
        "lost": slam.counts["frames_lost"],
    }


def checks(rows: list[Row], period: int, *, most_mb: float = _MOST_MB) -> list[Check]:
    """Return the checks: memory at the end, and what comes after the path was walked twice."""
    later = [row for row in rows if row["frames"] >= 2 * period]
    found = [Check("resident at the end", rows[-1]["resident MB"], "<=", most_mb, "MB")]
    for what in ("Gaussians", "trackable points"):
        growth = later[-1][what] / max(later[0][what], 1) if len(later) > 1 else None
        found.append(Check(f"{what}, end to second round", growth, "<=", _MOST_GROWTH))
    times = [row["tracking ms"] for row in later]
    quarter = len(times) // 4
    ratio = float(np.mean(times[-quarter:]) / np.mean(times[:quarter])) if quarter else None
    return [*found, Check("tracking time, last to first quarter", ratio, "<=", _MOST_GROWTH)]


def resident_mb() -> float:
    """Return the memory that this process has now, megabytes.

    Raises:
        BenchmarkError: the system does not say.
    """
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        raise BenchmarkError("memory: only Linux says what memory a process has now (/proc)") from None
    resident = next(line for line in lines if line.startswith("VmRSS:"))
    return int(resident.split()[1]) * 1024 / 1e6
