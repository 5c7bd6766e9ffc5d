# SPDX-License-Identifier: Apache-2.0
"""The nearest Gaussians of some Gaussians, for the identity's 3-D term."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import warp as wp

from ggwarp.kernels.identity.random import draw_points
from ggwarp.kernels.registration.hash_grid import allocate_hash_grid, build_hash_grid
from ggwarp.kernels.registration.k_nearest import find_k_nearest
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.runtime.state import FrameSource, State, Stateful
from ggwarp.runtime.streams import to_host

_SAMPLE = 10_000


class Neighbourhood(Stateful):
    """A search grid over a map's centres, rebuilt when Gaussians came or went.

    Centres move by millimetres at most between rebuilds: the neighbours are those of the last one.

    Attributes:
        samples: [S] int, the Gaussians last sampled.
        neighbours: [S, k] int, their nearest, themselves first.
    """

    def __init__(self, gaussians: GaussianMap, *, samples: int, k: int, seed: int) -> None:
        """Prepare to find the ``k`` nearest of ``samples`` Gaussians."""
        self._map = gaussians
        self._k = k
        self._seed = seed
        self._draws = 0
        self._version = -1
        self._grid: Any = None
        device = gaussians.device
        vec3: Any = wp.vec3
        self._queries = wp.empty(samples, dtype=vec3, device=device)
        self._distances2 = wp.empty((samples, k), dtype=float, device=device)
        self.samples = wp.empty(samples, dtype=int, device=device)
        self.neighbours = wp.empty((samples, k), dtype=int, device=device)

    def state(self) -> State:
        """Return the draws so far, and the centres as they were when the grid was built."""
        state: State = {"draws": self._draws, "version": self._version}
        if self._grid is not None:
            count, points = self._grid.count, to_host(self._grid.points)
            centres = np.empty((count, 3), np.float32)
            centres[to_host(self._grid.indices)[:count]] = points[:count]
            state |= {"room": len(points), "cell_size": float(self._grid.cell_size), "centres": centres}
        return state

    def restore(self, state: State, frames: FrameSource) -> None:
        """Build the same grid."""
        self._draws, self._version = state["draws"], state["version"]
        if "centres" in state:
            device, vec3 = self._map.device, cast(Any, wp.vec3)
            self._grid = allocate_hash_grid(state["room"], device=device)
            means = wp.array(state["centres"], dtype=vec3, device=device)
            build_hash_grid(self._grid, means, cell_size=state["cell_size"], device=device)

    def sample(self) -> None:
        """Fill ``samples`` with random Gaussians and ``neighbours`` with their nearest."""
        self._rebuild()
        draw_points(
            self._grid,
            seed=self._seed,
            draw=self._draws,
            indices=self.samples,
            points=self._queries,
            device=self._map.device,
        )
        self._draws += 1
        find_k_nearest(
            self._grid,
            self._queries,
            k=self._k,
            indices=self.neighbours,
            distances2=self._distances2,
            device=self._map.device,
        )

    def _rebuild(self) -> None:
        if self._version == self._map.version:
            return
        self._version = self._map.version
        means: Any = self._map.fields["means"][: self._map.count]
        if self._grid is None or self._grid.points.shape[0] < self._map.count:
            self._grid = allocate_hash_grid(self._map.capacity, device=self._map.device)
        build_hash_grid(self._grid, means, cell_size=self._cell_size(means), device=self._map.device)

    def _cell_size(self, means: Any) -> float:
        """Guess a cell that holds about ``k`` of the Gaussians, which lie on surfaces."""
        n = means.shape[0]
        sample = to_host(means[:: max(1, n // _SAMPLE)])
        low, high = np.quantile(sample, [0.1, 0.9], axis=0)
        return max(float((high - low).max()) * (self._k / n) ** 0.5, 1e-3)
