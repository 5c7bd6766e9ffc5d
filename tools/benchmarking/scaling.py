# SPDX-License-Identifier: Apache-2.0
"""``scaling``: how the cost of an iteration grows with Gaussians, pixels, channels and threads."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarking.inputs.clouds import situation, tracking_sequence
from benchmarking.inputs.scene import covering_size, scene_camera, scene_gaussians, scene_mapper
from benchmarking.machine import cores
from benchmarking.options import Common, cpu_threads, image_size, is_cpu, milliseconds, new_record
from benchmarking.record import Check, Record, Row, Section
from benchmarking.stages import view_load
from benchmarking.timing import measure
from benchmarking.tracking import growth
from ggwarp.config import device_name

COVERED, SAME_SIZE = "Gaussians, coverage held", "Gaussians, their size held"
PIXELS, CHANNELS = "image size, the scene held", "channels and threads"

_GAUSSIANS = (10_000, 30_000, 100_000, 300_000, 1_000_000)
_IMAGES = ("160x90", "320x180", "640x360", "960x540", "1200x680")
_BUDGET_S = 4.0
_MOST = 1.1  # exponent allowed by Gaussians and by pixels


@dataclass(frozen=True)
class ScalingOptions(Common):
    """Cost against Gaussians, image size, channels, threads and, for tracking, map size; fitted exponents."""

    gaussians: tuple[int, ...] = _GAUSSIANS
    """Numbers of Gaussians, ascending."""
    images: tuple[str, ...] = _IMAGES
    """Image sizes, ascending."""
    image: str = "640x360"
    """Image size while the number of Gaussians changes."""
    seq: str | None = None
    """Sequence for tracking; default: redkitchen under the data root, or else the built-in office."""
    data: Path | None = None
    """Data root; default: $GGWARP_DATA, else ./data."""
    rounds: int = 20
    """Repeats of each size; at least 3 are done, further ones within 4 seconds."""


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Return b of the least-squares fit time = a size^b, in logarithms; nan for fewer than two sizes."""
    if len(set(sizes)) < 2:
        return float("nan")
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def run(options: ScalingOptions) -> Record:
    """Measure and return the record.

    Raises:
        BenchmarkError: an option cannot be used.
        DatasetError: the sequence cannot.
    """
    record = new_record("scaling", options)
    device = device_name(options.device)
    rounds = 3 if options.quick else options.rounds
    numbers = options.gaussians[:3] if options.quick else options.gaussians
    images = options.images[:3] if options.quick else options.images
    fixed = image_size(options.image)

    def point(count: int, image: tuple[int, int], size: float, channels: int = 20) -> Row:
        return _measured(count, image, size, channels, device, rounds)

    covered = [point(n, fixed, covering_size(n, *fixed)) for n in numbers]
    note = f"at {options.image}: the more splats, the smaller: equally many contribute to a pixel"
    _add(record, COVERED, covered, "Gaussians", note)
    size = covering_size(numbers[0], *fixed)
    note = (
        f"at {options.image}, splats of {size:.1f} px: more lie on each other, until what is behind is hidden"
    )
    _add(record, SAME_SIZE, [point(n, fixed, size) for n in numbers], "Gaussians", note)
    views = [image_size(text) for text in images]
    note = "the same 20,000 Gaussians on more pixels: splats grow with the image"
    _add(record, PIXELS, [point(20_000, v, covering_size(20_000, *v)) for v in views], "pixels", note)
    _checks(record)
    rows = []
    for threads in sorted({1, cores()}) if is_cpu(record) else [cores()]:
        with cpu_threads(threads):
            for channels in (4, 20):
                rows.append({"threads": threads, **point(20_000, (320, 180), 2.0, channels)})
    record.sections.append(Section(CHANNELS, rows))
    root = options.data or Path(os.environ.get("GGWARP_DATA") or "data")
    at = situation(tracking_sequence(options.seq, root), 10, device=device)
    growth(record, at, (1, 10) if options.quick else (1, 2, 5, 10), device, rounds)
    return record


def _measured(
    count: int, image: tuple[int, int], size: float, channels: int, device: str, rounds: int
) -> Row:
    """Return the row of one scene."""
    camera = scene_camera(*image)
    mapper, _ = scene_mapper(
        scene_gaussians(count, camera, size=size, identity=channels == 20), camera, device=device
    )
    load = view_load(mapper.map, camera)
    time = measure({"iteration": mapper.iterate}, device=device, rounds=rounds, budget_s=_BUDGET_S)[
        "iteration"
    ]
    return {
        "Gaussians": count,
        "image": f"{image[0]}x{image[1]}",
        "pixels": image[0] * image[1],
        "channels": channels,
        "splat px": load.footprint,
        "pairs": load.pairs,
        "contributions a pixel": load.per_pixel,
        **milliseconds(time),
    }


def _add(record: Record, title: str, rows: list[Row], by: str, note: str) -> None:
    """Add a table, each row with the exponent since the one before it."""
    for before, row in zip([None, *rows[:-1]], rows, strict=True):
        step = None if before is None else exponent([before[by], row[by]], [before["ms"], row["ms"]])
        row["exponent since the last"] = step
    overall = exponent([r[by] for r in rows], [r["ms"] for r in rows])
    record.sections.append(Section(title, rows, f"{note}. Fitted: ms ~ {by}^{overall:.2f}"))


def _checks(record: Record) -> None:
    for title, by in ((COVERED, "Gaussians"), (SAME_SIZE, "Gaussians"), (PIXELS, "pixels")):
        section = record.section(title)
        assert section is not None
        rows = section.rows
        note = "" if len(rows) < 2 else f"last step {rows[-1]['exponent since the last']:.2f}"
        value = exponent([r[by] for r in rows], [r["ms"] for r in rows])
        record.checks.append(Check(f"exponent: {title}", value, "<=", _MOST, "", note))
