# SPDX-License-Identifier: Apache-2.0
"""Where an iteration looks at identities: a share of the image's tiles, drawn anew each time.

A row of tiles has every ``stride``-th one, each row two tiles after the one above: wherever an object is,
some of it is seen soon. Whole tiles, as their pixels share the work: a tile's warps wait for one another,
and where none looks at identities the lighter kernel does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

_SHIFT = wp.constant(2)


@dataclass(frozen=True)
class Sample:
    """Tiles of 16 x 16 pixels: one in ``stride``.

    Attributes:
        stride: 1: all of them.
        phase: [1] int in 0..stride - 1, on the device, so that a recorded graph sees changes; negative:
            none of them.
    """

    stride: int
    phase: Any


@wp.func
def first_tile(tile_y: int, stride: int, phase: wp.array[int]) -> int:
    """Column of the first tile in the sample in a row of tiles; every ``stride``-th after it is in it, too.

    Far beyond where there is none: with ``stride`` 0 or a negative phase. No ``phase`` array: phase 0.
    """
    first = int(0)
    if phase:
        first = phase[0]
    if stride < 1 or first < 0:
        return 1 << 30
    return (first + _SHIFT * tile_y) % stride


@wp.func
def in_sample(tile_x: int, tile_y: int, stride: int, phase: wp.array[int]) -> bool:
    """Whether a tile is in the sample."""
    first = first_tile(tile_y, stride, phase)
    if tile_x < first:
        return False
    return (tile_x - first) % stride == 0
