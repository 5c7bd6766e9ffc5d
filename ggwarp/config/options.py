# SPDX-License-Identifier: Apache-2.0
"""Every option of ``ggwarp run`` as a table: flag, default, help, group."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import textwrap
import typing
from dataclasses import dataclass
from typing import Any

from ggwarp.config.run_config import RunConfig

GROUPS: dict[str, tuple[str, ...]] = {
    "The recording": ("seq", "data", "frames", "masks", "masks-kind", "masks-void", "mono", "intrinsics"),
    "The method": ("config", "preset", "tracker", "loops", "policy", "use-identity", "refine"),
    "The machine and the pace": ("device", "scale", "fps", "pipelined", "memory"),
    "The results": ("out", "save-renders", "checkpoint-every", "resume", "start-from", "viewer", "viewer-at"),
}
"""The options that are not of one part of the system, by what they are about."""


@dataclass(frozen=True)
class Option:
    """One option of the command.

    Attributes:
        flag: as it is typed, with its dashes.
        default: as text; empty: there is none, and the help says what happens.
        choices: the values it takes, where they are few; ``yes`` and ``no`` stand for ``--x`` and ``--no-x``.
        help: whole sentences.
        group: a key of :data:`GROUPS`, or the part of the system that it belongs to, such as ``gicp``.
    """

    flag: str
    default: str
    help: str
    group: str
    choices: tuple[str, ...] = ()


def option_table() -> list[Option]:
    """Return every option but ``-h``, ``-v``, ``-q`` and their like, group by group."""
    groups = list(GROUPS)
    found = [*run_options(), *_command_options()]
    for option in found:
        if option.group not in groups:
            groups.append(option.group)
    return sorted(found, key=lambda o: (groups.index(o.group), _rank(o)))


def run_options() -> list[Option]:
    """Return the options that decide a run's results, in the order of their fields."""
    return _options(RunConfig(), "")


def changed_options(config: RunConfig) -> list[tuple[str, str, str]]:
    """Return flag, value and default of the options in which ``config`` differs from the defaults.

    Those of its preset are its defaults; where results and recordings lie is no option of a run.
    """
    from ggwarp.config.presets import preset_config

    defaults = {option.flag: option.default for option in _options(preset_config(config.preset), "")}
    found = [(o.flag, o.default, defaults.get(o.flag, "")) for o in _options(config, "")]
    return [
        (flag, value, default)
        for flag, value, default in found
        if value != default and flag not in ("--seq", "--data", "--out")
    ]


def _command_options() -> list[Option]:
    """Return what the command takes beside them: where a run starts from, and how it is kept."""
    from ggwarp.config.command_line import Command

    texts = _field_texts(Command)
    others = ("run", "resumed", "earlier", "verbose", "quiet")
    own = [f for f in dataclasses.fields(Command) if f.name not in others]
    named = [(f.name.replace("_", "-"), f) for f in own]
    return [Option(f"--{name}", _shown(f.default), texts[f.name], _group(name)) for name, f in named]


def _rank(option: Option) -> int:
    """Return the place within its group; options of one part stay in the order of its fields."""
    names = GROUPS.get(option.group, ())
    name = option.flag.removeprefix("--")
    return names.index(name) if name in names else 0


def _options(config: Any, prefix: str) -> list[Option]:
    found: list[Option] = []
    texts, hints = _field_texts(type(config)), typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        name = prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            # The system's own options stand beside the run's: --tracker, --mapper.iterations.
            found += _options(value, prefix if field.name == "slam" else f"{name}.")
        else:
            choices = _choices(hints[field.name])
            text = texts.get(field.name, "")
            found.append(Option(f"--{name}", _shown(value), text, _group(name), choices))
    return found


def _group(name: str) -> str:
    if "." in name:
        return name.partition(".")[0]
    return next((title for title, names in GROUPS.items() if name in names), "")


def _choices(hint: Any) -> tuple[str, ...]:
    if hint is bool:
        return ("yes", "no")
    return typing.get_args(hint) if typing.get_origin(hint) is typing.Literal else ()


def _shown(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (tuple, list)):
        return " ".join(map(_shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


@functools.cache
def _field_texts(owner: type) -> dict[str, str]:
    """Return field -> what stands right below it in the source."""
    texts: dict[str, str] = {}
    for base in reversed(owner.__mro__):
        if dataclasses.is_dataclass(base):
            [tree] = ast.parse(textwrap.dedent(inspect.getsource(base))).body
            texts |= _below_fields(typing.cast(ast.ClassDef, tree))
    return texts


def _below_fields(tree: ast.ClassDef) -> dict[str, str]:
    texts: dict[str, str] = {}
    for one, other in zip(tree.body, tree.body[1:], strict=False):
        if (
            isinstance(one, ast.AnnAssign)
            and isinstance(one.target, ast.Name)
            and isinstance(other, ast.Expr)
            and isinstance(other.value, ast.Constant)
        ):
            texts[one.target.id] = " ".join(str(other.value.value).split())
    return texts
