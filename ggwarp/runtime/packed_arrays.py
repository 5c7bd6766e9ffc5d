# SPDX-License-Identifier: Apache-2.0
"""Small arrays that lie together: one copy from the host to the device, and one back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from ggwarp.runtime.streams import to_host

_ALIGNMENT = 16
"""Bytes."""


class PackedArrays:
    """Arrays on a device that never move, and their image on the host.

    Attributes:
        host: by name, views of the image, to write to; of a struct type they are structured.
        device: by name, the arrays.
    """

    def __init__(self, layout: Mapping[str, tuple[Any, int | tuple[int, ...]]], device: Any) -> None:
        """Allocate, all zeros.

        Args:
            layout: name -> Warp type (a scalar, vector, matrix or struct) and shape.
        """
        self._places: dict[str, tuple[np.dtype[Any], Any, int]] = {}
        end = 0
        for name, (dtype, shape) in layout.items():
            row = numpy_type(dtype)
            self._places[name] = row, shape, end
            size = row.itemsize * (shape if isinstance(shape, int) else math.prod(shape))
            end += -(-size // _ALIGNMENT) * _ALIGNMENT
        host = np.zeros(end, np.uint8)
        byte: Any = wp.uint8
        self._image: Any = wp.array(host, dtype=byte, device="cpu", copy=False)
        self._bytes: Any = wp.zeros(end, dtype=byte, device=device)
        self.host = self._views(host)
        self.device: dict[str, Any] = {}
        for name, (dtype, shape) in layout.items():
            at = self._bytes.ptr + self._places[name][2]
            self.device[name] = wp.array(ptr=at, dtype=dtype, shape=shape, device=device)
            self.device[name]._ref = self._bytes

    def upload(self) -> None:
        """Copy the host's image to the device."""
        wp.copy(self._bytes, self._image)

    def read(self) -> dict[str, np.ndarray]:
        """Return what the device has, by name; waits for it. :attr:`host` stays as it was written."""
        return self._views(to_host(self._bytes).copy())

    def _views(self, image: np.ndarray) -> dict[str, np.ndarray]:
        return {name: np.ndarray(shape, row, image, at) for name, (row, shape, at) in self._places.items()}


@cache
def numpy_type(dtype: Any) -> np.dtype[Any]:
    """Return the NumPy type of a Warp scalar, vector, matrix or struct."""
    if hasattr(dtype, "numpy_dtype"):
        return np.dtype(dtype.numpy_dtype())
    one = wp.empty(1, dtype=dtype, device="cpu").numpy()
    return np.dtype((one.dtype, one.shape[1:]))


def as_rows(dtype: Any, values: Sequence[Any]) -> np.ndarray:
    """Return values of the Warp struct ``dtype`` as NumPy's, [n]; arrays in them go by their addresses."""
    return np.frombuffer(b"".join(bytes(value.__ctype__()) for value in values), numpy_type(dtype))
