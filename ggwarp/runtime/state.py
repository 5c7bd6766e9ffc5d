# SPDX-License-Identifier: Apache-2.0
"""What a checkpoint keeps of an object, and how the object gets it back.

A class with state derives from :class:`Stateful` and names its attributes in ``STATE``. Their values become a
tree: dictionaries with text for keys and lists, whose leaves are NumPy arrays and what JSON knows. Frames go
by reference: a checkpoint has their index and a checksum, and they are read again. No code is kept: a tree
can name the dataclasses that :func:`state_value` has registered, and nothing else.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from typing import Any, ClassVar, TypeVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.runtime.streams import to_host
from ggwarp.types import Exposure, Frame, FramePoints, StepReport, TrackResult, Verdict

State = dict[str, Any]
"""A tree; its arrays are copies that no later work writes to."""

FrameSource = Callable[[int], Frame]
"""Reads the frame of an index again."""

T = TypeVar("T", bound=type)

_ROWS = 16
_TAG = "$"
_NUMBERS: dict[type, Any] = {bool: np.bool_, int: np.int64, float: np.float64}


class StateError(ValueError):
    """A state is not that of the object that is to take it: one clause."""


class Stateful:
    """An object whose state is the attributes that ``STATE`` names; all else of it follows from these.

    An attribute may be another such object, an array on the host or the device, a random generator, a
    registered dataclass, or made of numbers, text, lists, tuples, sets and dictionaries of these.
    """

    STATE: ClassVar[tuple[str, ...]] = ()

    def state(self) -> State:
        """Return the state; waits for the device."""
        return state_of(self, self.STATE)

    def restore(self, state: State, frames: FrameSource) -> None:
        """Take over ``state``, which an object made alike had.

        Args:
            frames: reads frames of the sequence again.

        Raises:
            StateError, KeyError, TypeError, ValueError: it is no such state.
        """
        restore_into(self, self.STATE, state, frames)


def state_of(owner: object, names: Iterable[str]) -> State:
    """Return the state of the attributes ``names`` of ``owner``."""
    return {name: pack(getattr(owner, name)) for name in names}


def restore_into(owner: object, names: Iterable[str], state: State, frames: FrameSource) -> None:
    """Give the attributes ``names`` of ``owner`` back what :func:`state_of` returned."""
    for name in names:
        setattr(owner, name, restored(getattr(owner, name), state[name], frames))


_VALUES: dict[str, type] = {}


def state_value(cls: T) -> T:
    """Register a dataclass or an enumeration whose values may be part of a state.

    Raises:
        ValueError: another one has that name.
    """
    if _VALUES.setdefault(cls.__name__, cls) is not cls:
        raise ValueError(f"{cls.__name__}: {_VALUES[cls.__name__].__module__} has one of that name already")
    return cls


for _value in (Exposure, FramePoints, StepReport, TrackResult, Verdict):
    state_value(_value)


def frame_checksum(rgb: NDArray[np.uint8], depth: NDArray[np.float32] | None) -> int:
    """Return a checksum of a picture [h, w, 3] and its depth [h, w]; None: it has none.

    Of every 16th row: no two frames are alike in those, and it is asked for with every keyframe.
    """
    total = zlib.crc32(np.ascontiguousarray(rgb[::_ROWS]).data)
    return total if depth is None else zlib.crc32(np.ascontiguousarray(depth[::_ROWS]).data, total)


def reread(frames: FrameSource, index: int, checksum: int, *, with_depth: bool = True) -> Frame:
    """Return frame ``index``, read again.

    Raises:
        StateError: it is not the frame that it was.
    """
    frame = frames(index)
    if not with_depth:
        frame = dataclasses.replace(frame, depth=None, sensor_depth=None)
    if frame_checksum(frame.rgb, frame.depth) != checksum:
        raise StateError(f"frame {index} of the sequence is not the one that it was")
    return frame


def pack(value: Any) -> Any:
    """Return ``value`` as a tree.

    Raises:
        TypeError: it is of a kind that no state has.
    """
    if isinstance(value, Stateful):
        return value.state()
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return float(value) if isinstance(value, float) else value
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, wp.array):
        return to_host(value).copy()
    if isinstance(value, np.random.Generator):
        return dict(value.bit_generator.state)
    if isinstance(value, Frame):
        has_depth = value.depth is not None
        checksum = frame_checksum(value.rgb, value.depth)
        return {_TAG: "frame", "index": value.index, "checksum": checksum, "has_depth": has_depth}
    if isinstance(value, Enum):
        return {_TAG: "enum", "type": _name_of(value), "value": value.value}
    if dataclasses.is_dataclass(value):
        return {_TAG: "value", "type": _name_of(value), "fields": _fields_of(value)}
    if isinstance(value, (list, deque)):
        return _column(list(value))
    if isinstance(value, tuple):
        return {_TAG: "tuple", "values": [pack(v) for v in value]}
    if isinstance(value, (set, frozenset)):
        return {_TAG: "set", "values": _column(sorted(value))}
    if isinstance(value, Mapping):
        return {_TAG: "map", "keys": _column(list(value.keys())), "values": _column(list(value.values()))}
    raise TypeError(f"a state cannot hold a {type(value).__name__}")


def unpack(tree: Any, frames: FrameSource) -> Any:
    """Return the value of a tree that :func:`pack` made; for objects and arrays on a device see restored.

    Raises:
        StateError, KeyError, TypeError, ValueError: it is no such tree.
    """
    if isinstance(tree, list):
        return [unpack(v, frames) for v in tree]
    if not isinstance(tree, dict):
        return tree
    kind = tree.get(_TAG)
    if kind is None:
        return {name: unpack(v, frames) for name, v in tree.items()}
    if kind == "frame":
        return reread(frames, tree["index"], tree["checksum"], with_depth=tree["has_depth"])
    if kind == "enum":
        return _VALUES[tree["type"]](tree["value"])
    if kind == "value":
        return _VALUES[tree["type"]](**{k: unpack(v, frames) for k, v in tree["fields"].items()})
    if kind == "rows":
        columns = {k: unpack(v, frames) for k, v in tree["fields"].items()}
        rows = zip(*columns.values(), strict=True)
        return [_VALUES[tree["type"]](**dict(zip(columns, row, strict=True))) for row in rows]
    if kind == "tuple":
        return tuple(unpack(v, frames) for v in tree["values"])
    if kind == "set":
        return set(unpack(tree["values"], frames))
    if kind == "map":
        return dict(zip(unpack(tree["keys"], frames), unpack(tree["values"], frames), strict=True))
    if kind == "numbers":
        return tree["data"].tolist()
    if kind == "tuples":
        return [tuple(row) for row in tree["data"].tolist()]
    if kind == "arrays":
        return [a.copy() for a in np.split(tree["data"], np.cumsum(tree["lengths"])[:-1])]
    raise StateError(f"a part of kind {kind!r} is not known")


def restored(current: Any, tree: Any, frames: FrameSource) -> Any:
    """Return what an attribute with the value ``current`` becomes; objects and arrays take it over in place.

    Raises:
        StateError, KeyError, TypeError, ValueError: ``tree`` is not the state of such a value.
    """
    if isinstance(current, Stateful):
        current.restore(tree, frames)
        return current
    if isinstance(current, wp.array):
        return into_array(current, tree)
    if isinstance(current, np.random.Generator):
        current.bit_generator.state = tree
        return current
    value = unpack(tree, frames)
    if isinstance(current, deque):
        return deque(value, current.maxlen)
    return Counter(value) if isinstance(current, Counter) else value


def into_array(array: Any, values: NDArray[Any]) -> Any:
    """Return ``array`` filled with ``values``; another one where it is of another size.

    Raises:
        StateError: the rows are of another kind.
    """
    rows = tuple(getattr(array.dtype, "_shape_", ()))
    if not isinstance(values, np.ndarray) or values.shape[array.ndim :] != rows:
        raise StateError(f"an array has rows of another kind than {array.dtype.__name__}")
    if values.shape[: array.ndim] != array.shape:
        return wp.array(values, dtype=array.dtype, device=array.device)
    array.assign(values)
    return array


def _name_of(value: Any) -> str:
    name = type(value).__name__
    if _VALUES.get(name) is not type(value):
        raise TypeError(f"a state cannot hold a {name}, which is not registered")
    return name


def _fields_of(value: Any) -> dict[str, Any]:
    return {f.name: pack(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}


def _column(values: list[Any]) -> Any:
    """Return a list as few arrays, where its values are alike."""
    kinds = {type(v) for v in values}
    kind = next(iter(kinds)) if len(kinds) == 1 else None
    if kind in _NUMBERS and (kind is not int or _fit(values)):
        return {_TAG: "numbers", "data": np.array(values, _NUMBERS[kind])}
    if kind is np.ndarray and len({(v.dtype, v.shape[1:]) for v in values if v.ndim}) == 1:
        if all(v.ndim for v in values):
            lengths = np.array([len(v) for v in values], np.int64)
            return {_TAG: "arrays", "data": np.concatenate(values), "lengths": lengths}
    if kind is tuple and len({len(v) for v in values}) == 1:
        flat = [x for v in values for x in v]
        if flat and {type(x) for x in flat} == {int} and _fit(flat):
            return {_TAG: "tuples", "data": np.array(values, np.int64)}
    if kind is not None and _VALUES.get(kind.__name__) is kind and not issubclass(kind, Enum):
        names = [f.name for f in dataclasses.fields(values[0]) if f.init]
        fields = {name: _column([getattr(v, name) for v in values]) for name in names}
        return {_TAG: "rows", "type": kind.__name__, "fields": fields}
    return [pack(v) for v in values]


def _fit(values: Iterable[int]) -> bool:
    return all(-(1 << 63) <= v < 1 << 63 for v in values)
