# SPDX-License-Identifier: Apache-2.0
"""Keyframes as mapping sees them: arrays on the device."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import warp as wp


@dataclass(frozen=True)
class Keyframe:
    """A frame the map is fitted to, on the device.

    Attributes:
        index: the frame's.
        T_cw: [1] mat44, world to camera.
        colour: [h, w, 3] uint8.
        depth: [h, w] float, metres, 0 = none.
        labels: [h, w] int class of each pixel; None where there is no mask.
    """

    index: int
    T_cw: wp.array
    colour: wp.array
    depth: wp.array
    labels: wp.array | None


class Stage:
    """Room for one keyframe, always at the same place: recorded work reads it there."""

    def __init__(self) -> None:
        self._arrays: dict[str, Any] = {}

    def load(self, keyframe: Keyframe) -> Keyframe:
        """Return ``keyframe`` with its arrays copied here, on the device's current stream."""
        staged: dict[str, Any] = {}
        for name in (f.name for f in fields(keyframe)):
            array = getattr(keyframe, name)
            if isinstance(array, wp.array):
                if name not in self._arrays:
                    self._arrays[name] = wp.empty_like(array)
                wp.copy(self._arrays[name], array)
                staged[name] = self._arrays[name]
        return replace(keyframe, **staged)
