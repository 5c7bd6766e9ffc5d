# SPDX-License-Identifier: Apache-2.0
"""A run that goes on: what its checkpoint says, and which options may differ from then."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ggwarp.config.earlier_run import EarlierMap
from ggwarp.config.presets import config_of
from ggwarp.config.run_config import ConfigError, RunConfig
from ggwarp.io.camera import finite_number
from ggwarp.io.guarded import FileError
from ggwarp.io.printable import printable, shown
from ggwarp.io.toml import TomlError, parse_toml
from ggwarp.pipeline.tracking.tracker import TrackerError
from ggwarp.results.checkpoints import find_run

MAY_CHANGE = ("seq", "data", "frames", "refine", "device", "pipelined", "memory", "out", "save_renders")
"""The options of a run that goes on: they say where things are, and how much more is to be done."""


@dataclass(frozen=True)
class ResumedRun:
    """A run that goes on.

    Attributes:
        folder: holds its checkpoints. target: where it belongs when it is done.
        adopted: whether ``folder`` is an unfinished run's, to go on in.
        linked: whether ``runs/latest`` is to show it.
        config: its configuration; ``refine`` is what is left of it.
        tree: the checkpoint.
        done: frames behind it.
        refined: iterations of refinement behind it.
        wall_s: seconds that the run has taken so far.
        earlier: whose map it began in; None: in an empty one.
        faults: why newer checkpoints cannot be used, if there were any.
    """

    folder: Path
    target: Path
    adopted: bool
    linked: bool
    config: RunConfig
    tree: dict[str, Any]
    done: int
    refined: int
    wall_s: float
    earlier: EarlierMap | None
    faults: tuple[str, ...]


def open_resumed(run: Path) -> ResumedRun:
    """Read the newest checkpoint that is meant by ``run``; nothing is changed.

    Raises:
        ConfigError: there is none that can be used.
    """
    try:
        found = find_run(run)
        tree, faults = found.load()
        config = config_of(parse_toml(tree["config"], "config"), "its configuration")
        record = tree["record"]
        done, refined = (int(_amount(record[name])) for name in ("frames", "refine_iterations"))
        wall_s = _amount(record["wall_s"])
        # A run may have been given a name that looks like that of an unfinished one.
        target = found.folder if tree["target"] == found.folder.name else found.target
        linked = bool(tree["linked"])
        begun_in = tree["earlier"]
        earlier = begun_in and EarlierMap(Path(begun_in["folder"]), int(begun_in["checksum"]))
    except FileError as error:
        raise ConfigError(f"--resume {error}") from None
    except (TomlError, TrackerError, KeyError, TypeError, ValueError, AttributeError) as error:
        reason = error if isinstance(error, (TomlError, TrackerError, ConfigError)) else "parts are missing"
        raise ConfigError(
            f"--resume {printable(str(run))}: its checkpoint is not as this version writes it ({reason})"
        ) from None
    adopted = found.folder.resolve() != target.resolve()
    config = dataclasses.replace(config, refine=max(0, config.refine - refined))
    return ResumedRun(
        found.folder, target, adopted, linked, config, tree, done, refined, wall_s, earlier, tuple(faults)
    )


def _amount(value: Any) -> float:
    amount = finite_number(value)
    if amount is None or amount < 0.0:
        raise ValueError(f"{value} is no amount")
    return amount


def check_changes(before: RunConfig, asked: RunConfig) -> None:
    """Refuse options that a run cannot change on its way.

    Raises:
        ConfigError: names them.
    """
    changed = [flag for flag, _ in _differences(before, asked, "--")]
    if changed:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in MAY_CHANGE)
        value = shown(next(v for _, v in _differences(before, asked, "--")))
        raise ConfigError(
            f"{', '.join(changed)}: with --resume a run keeps what it began with ({changed[0]} {value}); "
            f"only {flags} and --checkpoint-every may differ"
        )


def _differences(before: Any, asked: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for field in dataclasses.fields(before):
        old, new = getattr(before, field.name), getattr(asked, field.name)
        name = prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(old):
            yield from _differences(old, new, prefix if field.name == "slam" else f"{name}.")
        elif old != new and not (prefix == "--" and field.name in MAY_CHANGE):
            yield name, old
