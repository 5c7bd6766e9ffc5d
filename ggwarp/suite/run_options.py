# SPDX-License-Identifier: Apache-2.0
"""Options of ``ggwarp run`` in a suite file: TOML keys named as the options are, checked, and as words."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from ggwarp.config import ConfigError, RunConfig, check
from ggwarp.config.checkpoint_interval import checkpoint_interval
from ggwarp.config.presets import config_of
from ggwarp.io.toml import TomlError, toml_value
from ggwarp.pipeline.slam_config import SlamConfig
from ggwarp.pipeline.tracking.tracker import TrackerError

Options = dict[str, Any]
"""Name of an option, without its dashes -> value; of a part's option ``part.option``."""

_OF_THE_SUITE = {
    "seq": "name it under sequences",
    "out": "every run has its own folder in the suite's",
    "data": "pass --data to ggwarp suite",
    "device": "pass --device to ggwarp suite",
    "mapper.seed": "list seeds",
    "built-in.seed": "list seeds",
}
_CHECKPOINTS = "checkpoint-every"
"""The one option that decides how a run is kept, not what it is."""

_SLAM = {field.name for field in dataclasses.fields(SlamConfig)}


class OptionsError(ValueError):
    """Options of a suite file cannot be used: what is wrong and the remedy, without the file's name."""


def flattened(table: Mapping[str, Any], prefix: str = "") -> Options:
    """Return the options of a TOML table, those of nested tables by dotted names.

    Raises:
        OptionsError: one is the suite's own business.
    """
    found: Options = {}
    for key, value in table.items():
        name = prefix + key.replace("_", "-")
        if isinstance(value, Mapping):
            found |= flattened(value, f"{name}.")
        elif name in _OF_THE_SUITE:
            raise OptionsError(f"{name} is no option here; {_OF_THE_SUITE[name]}")
        else:
            found[name] = value
    return found


def check_options(options: Options) -> None:
    """Refuse what ``ggwarp run`` would refuse whatever the sequence.

    Raises:
        OptionsError: an option is unknown, or has a value that it does not take.
    """
    values: dict[str, Any] = {"seq": "office"}
    of_runs = {name: value for name, value in options.items() if name != _CHECKPOINTS}
    for name, value in of_runs.items():
        parts, place = _path(name), values
        for part in parts[:-1]:
            place = place.setdefault(part, {})
        place[parts[-1]] = value
    try:
        config: RunConfig = config_of(values, "")
        check(config)
        checkpoint_interval(str(options.get(_CHECKPOINTS, "off")))
    except (TomlError, ConfigError, TrackerError) as error:
        raise OptionsError(str(error).removeprefix(": ").replace("slam.", "")) from None


def toml_lines(options: Options) -> list[str]:
    """Return the options as lines that ``ggwarp run --config`` reads."""
    return [f"{'.'.join(_path(name))} = {toml_value(value)}" for name, value in options.items()]


def _path(name: str) -> list[str]:
    """Return where an option stands in config.toml: --mapper.iterations is slam.mapper.iterations there."""
    parts = name.replace("-", "_").split(".")
    return ["slam", *parts] if parts[0] in _SLAM else parts


def words(options: Options) -> tuple[str, ...]:
    """Return the options as they are typed."""
    typed: list[str] = []
    for name, value in options.items():
        if isinstance(value, bool):
            head, dot, tail = name.rpartition(".")
            typed.append(f"--{name}" if value else f"--{head}{dot}no-{tail}")
        elif isinstance(value, list):
            typed += [f"--{name}", *map(str, value)]
        else:
            typed += [f"--{name}", str(value)]
    return tuple(typed)
