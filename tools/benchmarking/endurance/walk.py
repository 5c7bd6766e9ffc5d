# SPDX-License-Identifier: Apache-2.0
"""A sequence that never ends."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ggwarp.datasets import Dataset
from ggwarp.types import Frame


class Walk:
    """A sequence that goes on for as many frames as one wants: to and fro, or round."""

    def __init__(self, dataset: Dataset, *, length: int, frames: int) -> None:
        """Walk over the first ``length`` frames of ``dataset``, ``frames`` times in all."""
        self.name, self.kind, self.camera = dataset.name, dataset.kind, dataset.camera
        self.has_depth, self.has_masks = dataset.has_depth, dataset.has_masks
        self._inner, self._length, self._frames = dataset, length, frames
        first, last = dataset[0], dataset[length - 1]
        self._interval = (last.timestamp - first.timestamp) / (length - 1)
        ends = [frame.T_wc for frame in (first, last) if frame.T_wc is not None]
        self._round = len(ends) == 2 and np.allclose(*ends, atol=1e-3)

    def __len__(self) -> int:
        return self._frames

    @property
    def period(self) -> int:
        """Frames after which the camera is where it was, looking the same way."""
        return self._length - 1 if self._round else 2 * self._length - 2

    def scaled(self, scale: float) -> Walk:
        """Return the same walk with frames of another size, where the sequence renders its own."""
        other = Walk.__new__(Walk)
        other.__dict__.update(self.__dict__)
        scaled: Any = getattr(self._inner, "scaled", None)
        if scaled is not None:
            other._inner = scaled(scale)
            other.camera = other._inner.camera
        return other

    def __getitem__(self, index: int) -> Frame:
        at, sign = index % self.period, 1.0
        if at >= self._length:
            at, sign = self.period - at, -1.0
        frame = self._inner[at]
        now, depth = index * self._interval, frame.depth_timestamp
        if depth is not None:
            depth = now + sign * (depth - frame.timestamp)
        return dataclasses.replace(frame, index=index, timestamp=now, depth_timestamp=depth)
