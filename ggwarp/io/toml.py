# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses to TOML and back: nested ones become sections, None is left out.

Reading is strict: an unknown key or a value of the wrong type is an error that names it.
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar

from ggwarp.io import guarded
from ggwarp.io.atomic import atomic_write
from ggwarp.io.printable import printable, shown

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

T = TypeVar("T")

_NEEDED = " is needed"
_LARGEST: Any = (1 << 63) - 1
_DEEPEST = 16
_PART = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')[ \t]*"""
_DEEP_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_PART}(?:\.[ \t]*{_PART}){{{_DEEPEST}}}")
"""A dotted key of more parts than any section has: reading one takes the square of their number."""


class TomlError(ValueError):
    """A TOML file cannot be used: one line with the file, the key and the remedy."""


def write_toml(config: Any, path: Path) -> None:
    """Write the dataclass ``config`` to ``path``; values that are None are left out."""
    with atomic_write(path) as file:
        # TOML has no word for a name that is not UTF-8: it gets question marks.
        file.write(toml_text(config).encode(errors="replace"))


def toml_text(config: Any) -> str:
    """Return the dataclass ``config`` as TOML; values that are None are left out."""
    return "\n".join(_lines(config, "")) + "\n"


def read_toml(path: Path) -> dict[str, Any]:
    """Read ``path`` as plain values.

    Raises:
        TomlError: the file is missing, unreadable, too large, nested too deeply, or not TOML.
    """
    name = printable(str(path))
    if not path.exists():
        raise TomlError(f"{name}: no such file")
    try:
        text = guarded.read_text(path, guarded.CONFIG)
    except guarded.FileError as error:
        raise TomlError(str(error)) from None
    return parse_toml(text, name)


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """Return the plain values of ``text``, which is called ``name``.

    Raises:
        TomlError: it is nested too deeply, or not TOML.
    """
    if _DEEP_KEY.search(text):
        raise TomlError(f"{name}: a key has more than {_DEEPEST} parts; a section's key has two or three")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise TomlError(f"{name}: is nested too deeply") from None
    except tomllib.TOMLDecodeError as error:
        raise TomlError(f"{name}: {printable(str(error))}") from None
    except ValueError:  # of Python's own limit
        raise TomlError(f"{name}: a number has thousands of digits") from None


def merged(default: T, values: dict[str, Any], *, where: str, prefix: str = "") -> T:
    """Return the dataclass ``default`` with ``values`` put in.

    Args:
        values: field name -> value, with a dictionary for each nested dataclass.
        where: the file's name, for messages.
        prefix: the section these values stand in, with its dot, for messages.

    Raises:
        TomlError: a key is unknown or a value has the wrong type.
    """
    hints = typing.get_type_hints(type(default))
    known = [f.name for f in dataclasses.fields(default)]  # pyright: ignore[reportArgumentType]
    changes: dict[str, Any] = {}
    for key, value in values.items():
        name = prefix + key
        if key not in known:
            deeper = [f"{prefix}{n}.{key}" for n in known if key in _fields_of(getattr(default, n))]
            hint = f"did you mean {deeper[0]}?" if deeper else f"known here: {', '.join(sorted(known))}"
            raise TomlError(f"{where}: unknown key {shown(name)}; {hint}")
        current = getattr(default, key)
        if not dataclasses.is_dataclass(current):
            changes[key] = _converted(value, hints[key], f"{where}: {name} = {shown(value)}")
        elif isinstance(value, dict):
            changes[key] = merged(current, value, where=where, prefix=f"{name}.")
        else:
            raise TomlError(f"{where}: {name} = {shown(value)}, but a section [{name}] is needed")
    return dataclasses.replace(default, **changes)  # pyright: ignore[reportArgumentType, reportReturnType]


def _fields_of(value: Any) -> set[str]:
    return {f.name for f in dataclasses.fields(value)} if dataclasses.is_dataclass(value) else set()


def _lines(config: Any, section: str) -> list[str]:
    lines: list[str] = []
    nested: list[str] = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            name = f"{section}.{field.name}" if section else field.name
            nested += ["", f"[{name}]", *_lines(value, name)]
        elif value is not None:
            lines.append(f"{field.name} = {toml_value(value)}")
    return lines + nested


def toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)  # also inf and nan: TOML spells them alike
    if isinstance(value, (str, Path)):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    raise TypeError(f"no TOML for {value!r}")


def _converted(value: Any, hint: Any, what: str) -> Any:
    """Return ``value`` as the type ``hint``; ``what`` begins the message when it is another."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        if value in arguments:
            return value
        raise TomlError(f"{what}, but one of {', '.join(map(str, arguments))} is needed")
    if origin in (typing.Union, types.UnionType):
        return _one_of([a for a in arguments if a is not type(None)], value, what)
    if origin is tuple and isinstance(value, list):
        items = [arguments[0]] * len(value) if arguments[1:] == (...,) else list(arguments)
        if len(items) == len(value):
            return tuple(_converted(v, h, what) for v, h in zip(value, items, strict=True))
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if abs(value) > sys.float_info.max and isinstance(value, int):
            raise TomlError(f"{what}, but no number is that large")
        return float(value)
    if hint is Path and isinstance(value, str):
        if "\0" in value:
            raise TomlError(f"{what}, but no file's name holds a NUL")
        return Path(value)
    if hint in (int, bool, str) and type(value) is hint:
        if hint is int and not -_LARGEST <= value <= _LARGEST:
            raise TomlError(f"{what}, but no number is that large")
        return value
    raise TomlError(f"{what}, but {getattr(hint, '__name__', hint)} is needed")


def _one_of(hints: list[Any], value: Any, what: str) -> Any:
    needed: list[str] = []
    for hint in hints:
        try:
            return _converted(value, hint, what)
        except TomlError as error:
            if not str(error).endswith(_NEEDED):
                raise
            needed.append(str(error).removeprefix(f"{what}, but ").removesuffix(_NEEDED))
    raise TomlError(f"{what}, but {' or '.join(needed)} is needed")
