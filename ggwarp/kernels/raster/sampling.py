# SPDX-License-Identifier: Apache-2.0
"""Where an iteration looks at identities: a share of the image's bands of 4 rows, drawn anew each time.

A tile's column (16 pixels) has every ``stride``-th band, each column 3 bands after its neighbour: wherever
an object is, some of it is seen. A band of a tile is a row of patches on a CPU, two warps on CUDA: whole
registers, and whole warps, skip identities together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

BAND_ROWS = wp.constant(4)
"""Image rows of a band."""

_SHIFT = wp.constant(3)


@dataclass(frozen=True)
class Sample:
    """Blocks of 16 x 4 pixels: one in ``stride``.

    Attributes:
        stride: 1: all of them.
        phase: [1] int in 0..stride - 1, on the device, so that a recorded graph sees changes; negative:
            none of them.
    """

    stride: int
    phase: Any


@wp.func
def first_band(tile_x: int, tile_y: int, stride: int, phase: wp.array[int]) -> int:
    """First band in the sample, from a tile's top down; every ``stride``-th after it is in it, too.

    Far below where there is none: with ``stride`` 0 or a negative phase. No ``phase`` array: phase 0.
    """
    first = int(0)
    if phase:
        first = phase[0]
    if stride < 1 or first < 0:
        return 1 << 30
    # -4 tile_y, kept positive.
    return (first + _SHIFT * tile_x + 4 * (stride - 1) * tile_y) % stride


@wp.func
def in_sample(band: int, first: int, stride: int) -> bool:
    """Whether a band is in the sample; it and ``first`` (:func:`first_band`) count from one tile's top."""
    if band < first:
        return False
    return (band - first) % stride == 0
