# SPDX-License-Identifier: Apache-2.0
"""Two objects compared attribute by attribute, as deep as they go."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Any

import numpy as np
import warp as wp

from ggwarp.runtime.streams import to_host


def differences(one: Any, other: Any, scratch: set[str], *, where: str = "") -> Iterator[str]:
    """Yield where the attributes of two objects differ.

    Args:
        scratch: attributes that say nothing, as ``Class.name``: written before they are read.
    """
    yield from _compare(one, other, scratch, where or type(one).__name__, set())


def _compare(one: Any, other: Any, scratch: set[str], where: str, seen: set[int]) -> Iterator[str]:
    if type(one) is not type(other):
        yield f"{where}: {type(one).__name__} and {type(other).__name__}"
        return
    if id(one) in seen:
        return
    if isinstance(one, np.random.Generator):
        one, other = str(one.bit_generator.state), str(other.bit_generator.state)
    if isinstance(one, wp.array):
        one, other = to_host(one), to_host(other)
    if isinstance(one, np.ndarray):
        if one.dtype.names is None and not np.array_equal(one, other, equal_nan=one.dtype.kind == "f"):
            yield where
    elif one is None or isinstance(one, (bool, int, float, str, bytes, Enum, np.generic)):
        if one != other and not (one != one and other != other):
            yield f"{where}: {one!r} and {other!r}"
    elif isinstance(one, Mapping):
        ordered = not isinstance(one, OrderedDict)  # whose order says what was used last
        if set(one) != set(other) or (ordered and list(one) != list(other)):
            yield f"{where}: other keys"
        else:
            for key in one:
                yield from _compare(one[key], other[key], scratch, f"{where}[{key!r}]", seen)
    elif isinstance(one, (set, frozenset)):
        if one != other:
            yield where
    elif type(one).__module__.startswith("ggwarp"):
        seen.add(id(one))
        if isinstance(one, list):
            yield from _compare(list(one), list(other), scratch, where, seen)
        for name, value in _attributes(one).items():
            if not any(f"{base.__name__}.{name}" in scratch for base in type(one).__mro__):
                yield from _compare(value, getattr(other, name), scratch, f"{where}.{name}", seen)
    elif isinstance(one, (list, tuple)) or type(one).__name__ == "deque":
        if len(one) != len(other):
            yield f"{where}: {len(one)} and {len(other)} values"
        else:
            for i, (a, b) in enumerate(zip(one, other, strict=True)):
                yield from _compare(a, b, scratch, f"{where}[{i}]", seen)


def _attributes(value: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(value) and not hasattr(value, "__dict__"):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return dict(getattr(value, "__dict__", {}))
