# SPDX-License-Identifier: Apache-2.0
"""Measure ggwarp's speed beside its targets, the machine's limits and its peers.

    python tools/benchmark.py kernels
    python tools/benchmark.py tracking --seq redkitchen --data DIR

Prints tables and writes JSON and plots under benchmarks/; ``--help`` of each subcommand lists its options.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from benchmarking import kernels, plots, scaling, system, tracking, watched
from benchmarking.cubins import resources
from benchmarking.endurance import memory
from benchmarking.options import BenchmarkError, check_out
from benchmarking.record import Record, write_record
from benchmarking.tables import markdown, show
from ggwarp.config import ConfigError
from ggwarp.datasets import DatasetError
from ggwarp.runtime import loading

SUBCOMMANDS: dict[str, tuple[Any, Callable[[Any], Record]]] = {
    "kernels": (kernels.KernelsOptions, kernels.run),
    "tracking": (tracking.TrackingOptions, tracking.run),
    "system": (system.SystemOptions, system.run),
    "scaling": (scaling.ScalingOptions, scaling.run),
    "memory": (memory.MemoryOptions, memory.run),
    "watched": (watched.WatchedOptions, watched.run),
    "resources": (resources.ResourcesOptions, resources.run),
}
"""Name -> its options and what it runs."""

_PLAIN_WIDTH = 140  # columns of a table in a file or pipe


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code: 0, or 2 for a mistake of the user's."""
    options = tyro.extras.subcommand_cli_from_dict(
        {name: kind for name, (kind, _) in SUBCOMMANDS.items()},
        prog="benchmark",
        description=(__doc__ or "").split("\n")[0],
        args=arguments,
    )
    run = next(run for kind, run in SUBCOMMANDS.values() if type(options) is kind)
    loading.init_quietly()
    try:
        check_out(options.out)
        record = run(options)
        path = options.out or default_path(record)
        write_record(path, record)
    except (BenchmarkError, ConfigError, DatasetError) as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 2
    console = Console()
    if not console.is_terminal:
        console = Console(width=_PLAIN_WIDTH)
    show(record, console)
    if record.benchmark == "resources":  # tables alone, to be read where the file lies
        page = path.with_suffix(".md")
        page.write_text(markdown(record))
        console.print(f"written: {path}, {page}", markup=False, soft_wrap=True)
        return 0
    try:
        drawn = plots.draw(record, path.with_suffix(""))
    except plots.NoMatplotlibError as error:
        drawn = []
        print(f"benchmark: {error}", file=sys.stderr)
    console.print("written: " + ", ".join(map(str, [path, *drawn])), markup=False, soft_wrap=True)
    return 0


def default_path(record: Record) -> Path:
    """Return where a record goes without ``--out``: benchmarks/SUBCOMMAND-DEVICE.json."""
    device = re.sub(r"[^a-z0-9]+", "-", record.machine["device"].lower()).strip("-")
    return Path("benchmarks") / f"{record.benchmark}-{device}.json"


if __name__ == "__main__":
    sys.exit(main())
