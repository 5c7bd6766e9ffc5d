# SPDX-License-Identifier: Apache-2.0
"""Random choices made on the device: a hash of a seed and a counter, so that a run repeats to the bit."""

from __future__ import annotations

from typing import Any

import warp as wp

from ggwarp.kernels.raster.sampling import Sample
from ggwarp.kernels.registration.hash_grid import HashGrid

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _phase_kernel(seed: int, stride: int, none: int, draws: wp.array[int], phase: wp.array[int]):
    rng = wp.rand_init(seed, draws[0])
    phase[0] = wp.where(none != 0, -1, wp.randi(rng, 0, stride))
    draws[0] += 1


@wp.kernel
def _points_kernel(seed: int, draw: int, grid: HashGrid, indices: wp.array[int], points: wp.array[wp.vec3]):
    i = wp.tid()
    rng = wp.rand_init(seed, draw * indices.shape[0] + i)
    place = wp.randi(rng, 0, grid.count)
    indices[i] = grid.indices[place]
    points[i] = grid.points[place]


def draw_sample(sample: Sample, *, seed: int, draws: Any, none: bool = False, device: Any) -> None:
    """Draw where identities are looked at next.

    Args:
        sample: its phase is written: one of 0..stride - 1.
        draws: [1] int, draws so far; counted on the device, so that a recorded graph goes on drawing.
        none: they are looked at nowhere.
    """
    wp.launch(
        _phase_kernel,
        dim=1,
        inputs=[seed, sample.stride, int(none)],
        outputs=[draws, sample.phase],
        device=device,
    )


def draw_points(grid: Any, *, seed: int, draw: int, indices: Any, points: Any, device: Any) -> None:
    """Draw points of a grid, with replacement.

    Args:
        grid: built :class:`HashGrid` of at least one point.
        draw: number of the draw.
        indices: [m] int, written: the points' indices as given to the build.
        points: [m] wp.vec3, written: their positions.
    """
    wp.launch(
        _points_kernel,
        dim=indices.shape[0],
        inputs=[seed, draw, grid],
        outputs=[indices, points],
        device=device,
    )
