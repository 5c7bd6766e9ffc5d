# SPDX-License-Identifier: Apache-2.0
"""Splitting of ids that stand for two objects, because the tracker took them for one from the start.

What an id covers hangs together. A part that lies farther from the rest than either is large, and is never in
view with it, is another object, once several frames have shown it there. Parts that grow until they touch, or
come into view together, are one after all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.boxes import linked_parts
from ggwarp.geometry.voxels import labelled_voxels, voxel_centres
from ggwarp.objects.class_table import IGNORED, ClassTable
from ggwarp.objects.labels import solid
from ggwarp.objects.masks.mask_view import MaskView
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float64

_VOXEL = 0.1  # metres
_TOUCHING = 1.8 * _VOXEL  # between the centres of neighbouring voxels, corner to corner
_LEAST_GAP = 0.3  # far is at least so many metres...
_GAP = 1.0  # ... and so many times the diameter of the larger part
_LEAST_AREA = 5e-4  # a part covers at least this share of the image


@dataclass(frozen=True)
class SplittingConfig:
    """When an id's objects are two."""

    views: int = 3
    """An id is split when N frames have shown a part of it far from the rest; 0: an id is one object."""
    within_frames: bool = False
    """Objects that one frame shows under one id are split, too; without it, what one mask shows under one id
    is one object."""


@state_value
@dataclass(eq=False)
class _Part:
    """A place that an id was seen at; ``index`` is its class once it is taken for an object.

    ``voxels``: [k] the keys of the voxels that it lies in, each once.
    """

    voxels: NDArray[np.int64]
    index: int | None = None
    views: int = 1

    @cached_property
    def _keys(self) -> set[int]:
        return set(self.voxels.tolist())

    @cached_property
    def diameter(self) -> float:
        """Metres."""
        return float(np.linalg.norm(np.ptp(voxel_centres(self.voxels, _VOXEL), axis=0) + _VOXEL))

    def distances(self, points: Float64) -> Float64:
        """Return [k] how far each of ``points`` [k, 3] is from it, metres."""
        return _tree(voxel_centres(self.voxels, _VOXEL)).query(points)[0]

    def gap(self, other: _Part) -> float:
        """Return the distance between the two, metres."""
        if not self._keys.isdisjoint(other._keys):
            return 0.0  # as nearly always, and a thousand times as fast
        return float(self.distances(voxel_centres(other.voxels, _VOXEL)).min())

    def take(self, other: _Part) -> None:
        self.views += 1
        if new := other._keys - self._keys:
            self.__dict__.pop("diameter", None)  # it grows
            self._keys.update(new)
            self.voxels = np.append(self.voxels, np.sort(np.fromiter(new, np.int64)))


class SharedIdSplitter(Stateful):
    """Knows where each id's objects are, and splits what masks show of an id accordingly."""

    STATE = ("_parts",)

    def __init__(self, config: SplittingConfig, classes: ClassTable) -> None:
        """Prepare to look; ``classes`` grows with every object that is split off."""
        self._config = config
        self._classes = classes
        self._parts: dict[int, list[_Part]] = {}

    def split_shared_ids(self, mask: MaskView) -> MaskView:
        """Take in a frame; return it with each pixel under the object of its id that it lies nearest to."""
        if self._config.views == 0:
            return mask
        for label, part in self._seen_parts(mask):
            self._place(label, part)
        given, depth = mask.labels, mask.surface.depth
        out, fresh = given, set[int]()
        for label in sorted(self._parts):
            objects = [p for p in self._parts[label] if p.index is not None]
            if len(objects) < 2 or not (pixels := given == label).any():
                continue
            out = out.copy() if out is given else out
            points = mask.surface.places[:, (pixels & (depth > 0.0)).ravel()].T
            near = np.argmin([p.distances(points) for p in objects], axis=0)
            out[pixels] = IGNORED  # where there is no depth
            out[pixels & (depth > 0.0)] = np.array([p.index for p in objects], np.int32)[near]
            young = (p.index for p in objects if p.views <= 2 * self._config.views)
            fresh.update(index for index in young if index is not None and index != label)
        return mask if out is given else mask.with_labels(self._classes.merged(out), *fresh)

    def grown_together(self) -> list[tuple[int, int]]:
        """Return the objects (kept, gone) of one id that have grown together; they are one from now on."""
        found = []
        for parts in self._parts.values():
            objects = [p for p in parts if p.index is not None]
            for kept, gone in combinations(objects, 2):
                if gone in parts and kept in parts and kept.gap(gone) < _TOUCHING:
                    kept.take(gone)
                    parts.remove(gone)
                    found.append((kept.index, gone.index))
        return found

    def merge(self, kept: int, gone: int) -> None:
        """Take what was class ``gone`` for ``kept``."""
        parts = self._parts.pop(gone, [])
        for part in parts:
            part.index = kept if part.index == gone else part.index
        mine = self._parts.setdefault(kept, [])
        own = [p for p in (*mine, *parts) if p.index == kept]
        for other in own[1:]:
            own[0].take(other)
        self._parts[kept] = own[:1] + [p for p in (*mine, *parts) if p.index != kept]

    def _seen_parts(self, mask: MaskView) -> Iterator[tuple[int, _Part]]:
        """Yield (class, part) for what the frame shows of each id, and part by part if need be."""
        given, surface = mask.labels, mask.surface
        pixels = solid(given) & (given > 0) & (surface.depth > 0.0)
        if mask.knowledge is not None:
            known = mask.knowledge.known
            pixels &= (known < 0) | (self._classes.id_owners(known) == given)
        least = _LEAST_AREA * given.size
        seen = np.where(pixels, given, np.int32(IGNORED)).ravel()
        owners, keys, pixels_of = labelled_voxels(surface.places, seen, _VOXEL)
        begins = np.flatnonzero(np.diff(owners, prepend=IGNORED)).tolist()
        for begin, end in zip(begins, [*begins[1:], len(owners)], strict=False):
            label, places, counts = int(owners[begin]), keys[begin:end], pixels_of[begin:end]
            for members in self._parts_of(places):
                if counts[members].sum() >= least:
                    yield label, _Part(places[members])

    def _parts_of(self, places: NDArray[np.int64]) -> list[NDArray[np.intp]]:
        """Return the members of each part of what a frame shows of an id: voxels ``places`` [k]."""
        if self._config.within_frames:
            return _clusters(voxel_centres(places, _VOXEL), _LEAST_GAP)
        return [np.arange(len(places))]

    def _place(self, label: int, part: _Part) -> None:
        """Let what a frame shows of an id count for the object that it is of, or begin one."""
        parts = self._parts.setdefault(label, [])
        # Those that are objects already come first, then the nearest.
        near = [p for p in parts if self._near(p, part)]
        owner = min(near, key=lambda p: (p.index is None, p.gap(part)), default=None)
        if owner is None:
            parts.append(owner := part)
        else:
            owner.take(part)
        if owner.index is not None or owner.views < self._config.views:
            return
        objects = [p for p in parts if p.index is not None]
        if not objects:
            owner.index = label
        elif any(self._near(p, owner) for p in objects):
            parts.remove(owner)
        elif not self._classes.full:
            owner.index = self._classes.new_class(shares_id_of=label)
            self._classes.assign_id(owner.index)

    def _near(self, one: _Part, other: _Part) -> bool:
        gap = one.gap(other)
        return gap <= _LEAST_GAP or gap <= _GAP * max(one.diameter, other.diameter)


def _tree(points: Float64) -> Any:
    from scipy.spatial import KDTree

    return KDTree(points)


def _clusters(points: Float64, link: float) -> list[NDArray[np.intp]]:
    """Return the members of each part of ``points`` [k, 3] whose points are within ``link`` of another."""
    parts = linked_parts(_tree(points), link)
    return [np.nonzero(parts == i)[0] for i in range(parts.max() + 1)]
