# SPDX-License-Identifier: Apache-2.0
"""Objects that share an id, because the tracker took them for one from the start.

What an id covers hangs together. A part that lies farther from the rest than either is large, and is never in
view with it, is another object, once several frames have shown it there. Parts that grow until they touch, or
come into view together, are one after all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.boxes import linked_parts
from ggwarp.geometry.voxels import voxel_centres, voxel_keys
from ggwarp.objects.class_table import IGNORED, ClassTable
from ggwarp.objects.labels import Labels, solid, thinned
from ggwarp.objects.mask_view import PosedDepth
from ggwarp.types import Float64

_CELL = 0.1  # metres: places are told apart to so much
_TOUCHING = 1.8 * _CELL  # between the centres of neighbouring cells, corner to corner


@dataclass(frozen=True)
class SplittingConfig:
    """When an id's objects are two."""

    sightings: int = 3
    """Frames that must show a part of an id far from the rest of it; 0: an id is always one object."""
    least_gap: float = 0.3
    """Far is at least so many metres..."""
    gap: float = 1.0
    """... and so many times the diameter of the larger part."""
    least_area: float = 5e-4
    """A part covers at least this share of the image."""
    within_frames: bool = False
    """Tell apart what is in view together, too; without it masks are believed as to that."""


@dataclass(eq=False)
class _Part:
    """A place that an id was seen at; ``index`` is its class once it is taken for an object.

    ``cells``: [k] the numbers of the cells that it lies in, each once.
    """

    cells: NDArray[np.int64]
    index: int | None = None
    views: int = 1

    @property
    def diameter(self) -> float:
        """Metres."""
        return float(np.linalg.norm(np.ptp(voxel_centres(self.cells, _CELL), axis=0) + _CELL))

    def distances(self, points: Float64) -> Float64:
        """Return [k] how far each of ``points`` [k, 3] is from it, metres."""
        return _tree(voxel_centres(self.cells, _CELL)).query(points)[0]

    def gap(self, other: _Part) -> float:
        """Return the distance between the two, metres."""
        if np.intersect1d(self.cells, other.cells, assume_unique=True).size:
            return 0.0  # as nearly always, and a hundred times as fast
        return float(self.distances(voxel_centres(other.cells, _CELL)).min())

    def take(self, other: _Part) -> None:
        self.cells = np.union1d(self.cells, other.cells)
        self.views += 1


class SharedIdSplitter:
    """Knows where each id's objects are, and tells them apart."""

    def __init__(self, config: SplittingConfig, classes: ClassTable) -> None:
        """Prepare to look; ``classes`` grows with every object that is told from its namesake."""
        self._config = config
        self._classes = classes
        self._parts: dict[int, list[_Part]] = {}

    def tell_apart(self, given: Labels, known: Labels | None, view: PosedDepth) -> tuple[Labels, set[int]]:
        """Take in a frame; return its labels with namesakes told apart, and the newest of these.

        Args:
            given: [h, w] class of the mask's id; negative: none.
            known: [h, w] class that the map shows there for sure, else negative; None while the map is empty.
            view: where the pixels are.
        """
        if self._config.sightings == 0:
            return given, set()
        for label, part in self._seen_parts(given, known, view):
            self._place(label, part)
        out, fresh = given, set()
        for label in np.unique(given).tolist():
            objects = [p for p in self._parts.get(label, []) if p.index is not None]
            if len(objects) < 2:
                continue
            out = out.copy() if out is given else out
            pixels = given == label
            points = view.every_point(pixels)
            near = np.argmin([p.distances(points) for p in objects], axis=0)
            out[pixels] = IGNORED  # where there is no depth
            out[pixels & (view.depth > 0.0)] = np.array([p.index for p in objects], np.int32)[near]
            fresh |= {p.index for p in objects if p.index != label and p.views <= 2 * self._config.sightings}
        return self._classes.joined(out), fresh

    def touching(self) -> list[tuple[int, int]]:
        """Return the namesakes (kept, gone) that have grown together; they are one from now on."""
        found = []
        for parts in self._parts.values():
            objects = [p for p in parts if p.index is not None]
            for kept, gone in combinations(objects, 2):
                if gone in parts and kept in parts and kept.gap(gone) < _TOUCHING:
                    kept.take(gone)
                    parts.remove(gone)
                    found.append((kept.index, gone.index))
        return found

    def join(self, kept: int, gone: int) -> None:
        """Take what was class ``gone`` for ``kept``."""
        parts = self._parts.pop(gone, [])
        for part in parts:
            part.index = kept if part.index == gone else part.index
        mine = self._parts.setdefault(kept, [])
        own = [p for p in (*mine, *parts) if p.index == kept]
        for other in own[1:]:
            own[0].take(other)
        self._parts[kept] = own[:1] + [p for p in (*mine, *parts) if p.index != kept]

    def _seen_parts(
        self, given: Labels, known: Labels | None, view: PosedDepth
    ) -> Iterator[tuple[int, _Part]]:
        """Yield (class, part) for what the frame shows of each id, and part by part if need be."""
        grid = thinned(*given.shape)
        pixels = np.zeros(given.shape, bool)
        pixels[grid] = solid(given[grid]) & (given[grid] > 0) & (view.depth[grid] > 0.0)
        if known is not None:
            pixels &= (known < 0) | (self._classes.namesake_of(known) == given)
        least = self._config.least_area * given[grid].size
        labels = given[pixels]
        cells = voxel_keys(view.every_point(pixels), _CELL)
        for label in np.unique(labels).tolist():
            places, counts = np.unique(cells[labels == label], return_counts=True)
            for members in self._parts_of(places):
                if counts[members].sum() >= least:
                    yield label, _Part(places[members])

    def _parts_of(self, places: NDArray[np.int64]) -> list[NDArray[np.intp]]:
        """Return the members of each part of what a frame shows of an id: cells ``places`` [k]."""
        if self._config.within_frames:
            return _clusters(voxel_centres(places, _CELL), self._config.least_gap)
        return [np.arange(len(places))]

    def _place(self, label: int, part: _Part) -> None:
        """Let what a frame shows of an id count for the object that it is of, or begin one."""
        c, parts = self._config, self._parts.setdefault(label, [])
        # Those that are objects already come first, then the nearest.
        near = [p for p in parts if self._near(p, part)]
        owner = min(near, key=lambda p: (p.index is None, p.gap(part)), default=None)
        if owner is None:
            parts.append(owner := part)
        else:
            owner.take(part)
        if owner.index is not None or owner.views < c.sightings:
            return
        objects = [p for p in parts if p.index is not None]
        if not objects:
            owner.index = label
        elif any(self._near(p, owner) for p in objects):
            parts.remove(owner)
        else:
            owner.index = self._classes.begin(like=label)
            self._classes.name(owner.index)

    def _near(self, one: _Part, other: _Part) -> bool:
        c = self._config
        far = max(c.least_gap, c.gap * max(one.diameter, other.diameter))
        return one.gap(other) <= far


def _tree(points: Float64) -> Any:
    from scipy.spatial import KDTree

    return KDTree(points)


def _clusters(points: Float64, link: float) -> list[NDArray[np.intp]]:
    """Return the members of each part of ``points`` [k, 3] whose points are within ``link`` of another."""
    parts = linked_parts(_tree(points), link)
    return [np.nonzero(parts == i)[0] for i in range(parts.max() + 1)]
