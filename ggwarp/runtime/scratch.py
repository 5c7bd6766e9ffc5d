# SPDX-License-Identifier: Apache-2.0
"""Arrays on a device that are kept from one use to the next.

On CUDA a freed array is given back in the order of the device's legacy stream, which everything waits for:
who works frame by frame keeps what he works in.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

_GROWTH = 1.25


class ScratchArrays:
    """Hands out arrays by name; one is valid until its name is asked for again."""

    def __init__(self, device: Any) -> None:
        """Keep nothing yet; all is on ``device``."""
        self._device = device
        self._kept: dict[str, Any] = {}
        self._last: dict[str, Any] = {}  # as it was asked for last

    def take(self, name: str, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Return an array of ``shape`` and ``dtype``, with anything in it: that of ``name`` if it will do."""
        shape = (shape,) if isinstance(shape, int) else shape
        last = self._last.get(name)
        if last is not None and last.shape == shape and last.dtype == dtype:
            return last
        size = math.prod(shape)
        kept = self._kept.get(name)
        if kept is None or kept.shape[0] < size or kept.dtype != dtype:
            room = max(1, math.ceil(_GROWTH * size))
            kept = self._kept[name] = wp.empty(room, dtype=dtype, device=self._device)
        some: Any = kept[:size]
        self._last[name] = some.reshape(shape)
        return self._last[name]

    def upload(self, name: str, values: np.ndarray, dtype: Any) -> Any:
        """Return :meth:`take`'s array with ``values`` in it, whose last axis is a vector dtype's own."""
        vector = wp.types.type_is_vector(dtype)
        array = self.take(name, values.shape[:-1] if vector else values.shape, dtype)
        if values.size:
            array.assign(values)
        return array
