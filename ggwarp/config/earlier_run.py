# SPDX-License-Identifier: Apache-2.0
"""The run that another one starts from: what is refused of it."""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ggwarp.config.run_config import ConfigError
from ggwarp.io.printable import printable
from ggwarp.io.toml import TomlError, read_toml
from ggwarp.results.saved_run import RunError, SavedRun, load_run


@dataclass(frozen=True)
class EarlierMap:
    """Which run's map another one began in: its folder, and :func:`map_checksum` of the map."""

    folder: Path
    checksum: int


def map_checksum(run: SavedRun) -> int:
    """Return a checksum of the map of ``run``."""
    total = 0
    for values in run.gaussians.arrays().values():
        total = zlib.crc32(values.tobytes(), total)
    return total


def open_earlier(run: Path, out: Path | None) -> SavedRun:
    """Read the run to start from; nothing of it is changed.

    Args:
        out: the new run's folder, if it is said.

    Raises:
        ConfigError: it cannot be started from.
    """
    name = f"--start-from {printable(str(run))}"
    if out is not None and os.path.realpath(out) == os.path.realpath(run):
        raise ConfigError(f"{name}: --out is the same run, which is never changed; choose another --out")
    try:
        found = load_run(run)
    except RunError as error:
        raise ConfigError(f"--start-from {printable(str(error))}") from None
    if not len(found.gaussians) or not len(found.poses):
        raise ConfigError(f"{name}: its map is empty")
    if _is_monocular(run):
        raise ConfigError(f"{name}: its map is of colour alone and has no scale; start from a run with depth")
    return found


def _is_monocular(run: Path) -> bool:
    """Return whether the configuration of ``run`` says so; a run of the library has none."""
    if not (run / "config.toml").is_file():
        return False
    try:
        slam: Any = read_toml(run / "config.toml").get("slam")
    except TomlError as error:
        raise ConfigError(f"--start-from {error}") from None
    return isinstance(slam, dict) and slam.get("mono") is True
