# SPDX-License-Identifier: Apache-2.0
"""What all subcommands are told, and how they refuse."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarking.machine import cores, describe
from benchmarking.record import Record, settings_of
from ggwarp.config import device_name
from ggwarp.runtime import launch

_BUSY = 0.5  # load a core at the start from which on figures are doubtful


class BenchmarkError(ValueError):
    """An option cannot be used: one line for the user."""


@dataclass(frozen=True)
class Common:
    """Options of every subcommand."""

    device: str = "auto"
    """auto (CUDA if there is one), cpu or cuda:N."""
    quick: bool = False
    """Fewer repeats and sizes: a look, not a result."""
    out: Path | None = None
    """JSON file; default: benchmarks/SUBCOMMAND-DEVICE.json. Plots lie beside it."""


def new_record(benchmark: str, options: Common) -> Record:
    """Return a record without results, of the device that ``options`` mean."""
    settings = settings_of(options)
    for place in ("out", "data"):  # of this machine alone
        settings.pop(place, None)
    record = Record(benchmark, describe(device_name(options.device)), settings)
    load = record.machine["load"]
    if load is not None and load > _BUSY * cores():
        record.notes.append(
            f"other processes ran beside (load {load:.1f} on {cores()} cores): not a result to keep"
        )
    return record


def check_out(path: Path | None) -> None:
    """Refuse a record's place that cannot be written to.

    Raises:
        BenchmarkError: it is a folder, or lies in what is none.
    """
    if path is None:
        return
    if path.is_dir():
        raise BenchmarkError(f"--out {path}: is a folder; name a JSON file, such as {path / 'record.json'}")
    if any(parent.exists() and not parent.is_dir() for parent in path.parents):
        raise BenchmarkError(f"--out {path}: lies in a file; name a JSON file in a folder")


def thread_count(wanted: int | None) -> int:
    """Return the CPU threads to use.

    Raises:
        BenchmarkError: fewer than one.
    """
    if wanted is not None and wanted < 1:
        raise BenchmarkError(f"--threads {wanted}: give 1 or more")
    return wanted or cores()


def image_size(text: str) -> tuple[int, int]:
    """Return (width, height) of WxH.

    Raises:
        BenchmarkError: it is not of that form, or too small.
    """
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise BenchmarkError(f"--size {text}: expected WIDTHxHEIGHT in pixels, such as 320x180") from None
    if min(width, height) < 16:
        raise BenchmarkError(f"--size {text}: at least 16 pixels a side are needed")
    return width, height


@contextlib.contextmanager
def cpu_threads(count: int) -> Iterator[None]:
    """Let CPU launches use ``count`` threads for a while."""
    kept = launch.cpu_threads()
    launch.set_cpu_threads(count)
    try:
        yield
    finally:
        launch.set_cpu_threads(kept)


def is_cpu(record: Record) -> bool:
    """Return whether ``record`` was measured without a GPU."""
    return record.machine["device"] == "cpu"


def percent(share: float) -> float:
    return 100.0 * share


def milliseconds(timing: Any) -> dict[str, float]:
    """Return the columns of a :class:`benchmarking.timing.Timing`."""
    return {"ms": 1e3 * timing.median, "spread %": percent(timing.spread)}
