# SPDX-License-Identifier: Apache-2.0
"""Suites from their TOML files: every mistake is one line that names the file, the key and the remedy."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

from ggwarp.config import Preset
from ggwarp.io.printable import printable, shown
from ggwarp.io.suggestion import did_you_mean
from ggwarp.io.toml import TomlError, merged, read_toml
from ggwarp.results.metrics import RESULTS
from ggwarp.suite.definition import METRICS, PUBLISHED, SHIPPED, Choice, Sequence, Setting, Suite, SuiteError
from ggwarp.suite.job import Resources
from ggwarp.suite.run_options import Options, OptionsError, flattened

T = TypeVar("T")

_KEYS = (
    *("title", "metrics", "seeds", "published", "fetch", "options", "sequences", "settings", "grid"),
    *("resources", "choice"),
)
_KNOWN_METRICS = {name for names in RESULTS.values() for name in names}
_MOST_JOBS = 1_000_000


def load_suite(name: str) -> Suite:
    """Return the suite in the file ``name``, or the shipped one of that name.

    Raises:
        SuiteError: there is none, or it cannot be used.
    """
    path = Path(name)
    shipped = {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}
    if not path.is_file() and name in shipped:
        path = shipped[name]
    elif not path.exists():
        raise SuiteError(
            f"{printable(name)}: no such file{did_you_mean(name, shipped)}; "
            f"name a TOML file, or one of {', '.join(shipped)}"
        )
    try:
        values = read_toml(path)
    except TomlError as error:
        raise SuiteError(str(error)) from None
    try:
        return suite_of(values, path.stem)
    except SuiteError as error:
        raise SuiteError(f"{printable(str(path))}: {error}") from None


def suite_of(values: Mapping[str, Any], name: str) -> Suite:
    """Return the suite that the ``values`` of a TOML file say.

    Raises:
        SuiteError: a key is unknown, missing, or has a value that cannot be used.
    """
    for key in values:
        if key not in _KEYS:
            known = ", ".join(_KEYS)
            raise SuiteError(f"unknown key {shown(key)}{did_you_mean(key, _KEYS)}; known: {known}")
    suite = Suite(
        name,
        title=_typed(values, "title", str, name),
        sequences=_sequences(values),
        settings=_settings(values),
        seeds=_seeds(values),
        options=_options(values.get("options", {}), "[options]"),
        metrics=_metrics(values),
        published=_published(values),
        fetch=_fetch(values),
        resources=_resources(values),
        choice=_choice(values),
    )
    if (count := len(suite.sequences) * len(suite.settings) * len(suite.seeds)) > _MOST_JOBS:
        raise SuiteError(f"has {count:,} runs; {_MOST_JOBS:,} are the most, cut it in parts")
    suite.check()
    return suite


def _typed(values: Mapping[str, Any], key: str, kind: type[T], default: T) -> T:
    value = values.get(key, default)
    if not isinstance(value, kind):
        raise SuiteError(f"{key} = {shown(value)}, but {kind.__name__} is needed")
    return value


def _names(values: Mapping[str, Any], key: str, default: tuple[str, ...]) -> list[str]:
    found = _typed(values, key, list, list(default))
    if not found or not all(isinstance(item, str) and item for item in found):
        raise SuiteError(f"{key} = {shown(found)}, but a list of names is needed")
    return found


def _sequences(values: Mapping[str, Any]) -> tuple[Sequence, ...]:
    """Return the sequences of a list of names, or of tables with options of their own."""
    if "sequences" not in values:
        raise SuiteError('sequences is missing; such as sequences = ["office0"]')
    if isinstance(values["sequences"], list):
        return tuple(Sequence(seq, seq) for seq in _names(values, "sequences", ()))
    tables = _typed(values, "sequences", dict, {})
    if not tables:
        raise SuiteError("[sequences] is empty; name at least one")
    found: list[Sequence] = []
    for title, table in tables.items():
        where = f"[sequences.{title}]"
        if not isinstance(table, dict):
            raise SuiteError(f"{where} = {shown(table)}, but a table is needed, such as {{ seq = 'walk' }}")
        seq = table.get("seq", title)
        if not isinstance(seq, str):
            raise SuiteError(f"{where}: seq = {shown(seq)}, but str is needed")
        found.append(Sequence(title, seq, _options({k: v for k, v in table.items() if k != "seq"}, where)))
    return tuple(found)


def _settings(values: Mapping[str, Any]) -> tuple[Setting, ...]:
    """Return the settings that are named, then those of the grid."""
    found: list[Setting] = []
    for title, table in _typed(values, "settings", dict, {}).items():
        if not isinstance(table, dict):
            raise SuiteError(f"settings.{title} = {shown(table)}, but a table of options is needed")
        found.append(Setting(title, _options(table, f"[settings.{title}]")))
    grid = _options(_typed(values, "grid", dict, {}), "[grid]")
    for option, choices in grid.items():
        if not isinstance(choices, list) or not choices:
            raise SuiteError(f"[grid]: {option} = {shown(choices)}, but a list of values is needed")
    if grid:
        for choice in itertools.product(*grid.values()):
            options = dict(zip(grid, choice, strict=True))
            found.append(Setting(", ".join(map(_called, options.items())), options))
    return tuple(found) or (Setting("defaults"),)


def _called(option: tuple[str, Any]) -> str:
    """Return how a setting of the grid calls one of its values: fast, iterations 5."""
    name, value = option
    return str(value) if value in get_args(Preset) else f"{name.rpartition('.')[2]} {value}"


def _options(table: Any, where: str) -> Options:
    if not isinstance(table, dict):
        raise SuiteError(f"{where} = {shown(table)}, but a table of options is needed")
    try:
        return flattened(table)
    except OptionsError as error:
        raise SuiteError(f"{where}: {error}") from None


def _seeds(values: Mapping[str, Any]) -> tuple[int, ...]:
    seeds = values.get("seeds", [0])
    good = isinstance(seeds, list) and seeds and all(type(seed) is int and seed >= 0 for seed in seeds)
    if not good or len(set(seeds)) != len(seeds):
        raise SuiteError(f"seeds = {shown(seeds)}, but different whole numbers from 0 are needed")
    return tuple(seeds)


def _metrics(values: Mapping[str, Any]) -> tuple[str, ...]:
    metrics = _names(values, "metrics", METRICS)
    for metric in metrics:
        if metric not in _KNOWN_METRICS:
            meant = did_you_mean(metric, _KNOWN_METRICS)
            raise SuiteError(f"metrics: no run measures {shown(metric)}{meant}")
    return tuple(metrics)


def _published(values: Mapping[str, Any]) -> str:
    name = _typed(values, "published", str, "")
    known = [path.stem for path in PUBLISHED.glob("*.toml")]
    if name and name not in known:
        meant = did_you_mean(name, known)
        raise SuiteError(f"published = {shown(name)}: no such rows{meant}; there are {', '.join(known)}")
    return name


def _fetch(values: Mapping[str, Any]) -> str:
    command = _typed(values, "fetch", str, "")
    if command and "{folder}" not in command:
        raise SuiteError(f"fetch = {shown(command)}: say with {{folder}} where the sequence shall go")
    try:
        shlex.split(command)
    except ValueError as error:
        raise SuiteError(f"fetch = {shown(command)}: {error}; it is split in words as a shell does") from None
    return command


def _resources(values: Mapping[str, Any]) -> Resources:
    table = _typed(values, "resources", dict, {})
    try:
        found = merged(Resources(), table, where="", prefix="resources.")
    except TomlError as error:
        raise SuiteError(str(error).removeprefix(": ")) from None
    if found.cpus < 1 or found.memory_gb <= 0.0 or (found.gpus or 0.0) < 0.0:
        raise SuiteError("[resources]: cpus must be 1 or more, memory_gb above 0, gpus 0 or more")
    return found


def _choice(values: Mapping[str, Any]) -> Choice | None:
    if "choice" not in values:
        return None
    try:
        return merged(Choice(), _typed(values, "choice", dict, {}), where="", prefix="choice.")
    except TomlError as error:
        raise SuiteError(str(error).removeprefix(": ")) from None
