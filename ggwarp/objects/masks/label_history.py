# SPDX-License-Identifier: Apache-2.0
"""Masks against the map: which object carries a wrong id in a frame.

A tracker that swaps two ids, loses an object or revives it under another id is wrong about a whole object at
once. The map remembers what each place of the object was called before: one frame cannot rename it, more
frames than those that called it so can, unless these were several: a track that slips to another object for
good takes nothing with it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.voxels import labelled_voxels, voxel_keys
from ggwarp.objects.class_table import IGNORED, NO_OBJECT, ClassTable
from ggwarp.objects.labels import Labels, as_runs, from_runs
from ggwarp.objects.masks.mask_view import MaskView
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32

_VOXEL = 0.25  # metres
_LEAST_PIXELS = 20
_MAJORITY = 0.5
_CLEAR = 0.8
_ESTABLISHED = 4
"""What came under its object's own name in so many views keeps it: the tracker's ids went astray."""


class LabelHistory(Stateful):
    """How often each place of each object of the map carried which label, in views.

    By place, as an object begun under another's id is not that other because that one often came.
    """

    STATE = ("_views", "_kept")

    def __init__(self, classes: ClassTable) -> None:
        """Prepare to count; ``classes`` says which objects share an id."""
        self._classes = classes
        self._views: Counter[tuple[int, int, int]] = Counter()  # (voxel, object, label)
        self._kept: dict[int, NDArray[np.uint16]] = {}

    def adopt(self, means: Float32, classes: Labels) -> None:
        """Take the places of an earlier map's objects for established.

        Args:
            means: [n, 3] its Gaussians' centres, metres, world frame. classes: [n] their objects'.
        """
        some = classes > NO_OBJECT
        places = zip(
            voxel_keys(means[some].astype(np.float64), _VOXEL).tolist(), classes[some].tolist(), strict=True
        )
        self._views.update({(voxel, m, m): _ESTABLISHED for voxel, m in places})

    def keep(self, index: int, labels: Labels) -> None:
        """Keep the labels that frame ``index`` came with, [h, w]."""
        self._kept[index] = as_runs(labels)

    def kept(self, index: int, shape: tuple[int, ...]) -> Labels | None:
        """Return the labels that frame ``index`` came with, merged since; None: they were not kept.

        Args:
            shape: height and width of the frame's images.
        """
        if index not in self._kept:
            return None
        return from_runs(self._kept[index], shape, self._classes.merged)

    def correct(self, mask: MaskView, *, anew: bool = True) -> MaskView:
        """Take in a view; return it with the labels replaced that are wrong about an object of the map.

        Args:
            mask: with what the map knows.
            anew: count the view; False: it was taken in before.
        """
        assert mask.knowledge is not None
        # Of objects that share an id the place says which it is.
        wrong = [p for p in self.wrong_labels(mask, anew=anew) if not self._classes.same_mask_id(*p)]
        return mask.with_labels(corrected(mask.knowledge.known, mask.labels, wrong)) if wrong else mask

    def wrong_labels(self, mask: MaskView, *, anew: bool = True) -> list[tuple[int, int]]:
        """Take in a view; return (object, label) where the label is wrong about the object.

        Arguments as of :meth:`correct`.
        """
        assert mask.knowledge is not None
        table = mask.overlaps[1:, 1:]
        sizes, usual = table.sum(axis=1), table.argmax(axis=1)
        differs = (usual != np.arange(len(table))) & (table.max(axis=1) > _MAJORITY * sizes)
        doubtful = np.flatnonzero(differs & (sizes >= _LEAST_PIXELS)).tolist()
        if not anew and not doubtful:
            return []
        places = _places(mask.surface.places, mask.known.ravel(), mask.labels.ravel())
        if anew:
            self._views.update(places.labelled)
        wrong: list[tuple[int, int]] = []
        for m in doubtful:
            label = int(usual[m])
            own, other = (self._mean_views(places, m, name) for name in (m, label))
            # Its own name came at least once: with the keyframe that made it.
            if own >= _ESTABLISHED or other <= max(own, 1.0):
                wrong.append((m, label))
        return wrong

    def merge(self, kept: int, gone: int) -> None:
        """Count what was seen of class ``gone`` for ``kept``."""
        for place, m, label in [key for key in self._views if gone in key[1:]]:
            key = place, kept if m == gone else m, kept if label == gone else label
            self._views[key] += self._views.pop((place, m, label))

    def _mean_views(self, places: _Places, m: int, label: int) -> float:
        """Return in how many views what is seen of object ``m`` was called ``label``, by pixel."""
        mine = places.objects == m
        views = [self._views[place, m, label] for place in places.voxels[mine].tolist()]
        return float(np.average(views, weights=places.sizes[mine]))


@dataclass(frozen=True)
class _Places:
    """The places at which a view shows objects of the map.

    Attributes:
        voxels, objects, sizes: [k] voxel, object and number of pixels of each.
        labelled: (voxel, object, label) where most of these pixels have one label.
    """

    voxels: NDArray[np.int64]
    objects: NDArray[np.int64]
    sizes: NDArray[np.int64]
    labelled: list[tuple[int, int, int]]


def _places(points: Float32, objects: Labels, labels: Labels) -> _Places:
    """Sort the pixels, [n] each, whose object and label are known by the voxels that they lie in.

    Args:
        points: [3, n] where they are, metres.
    """
    size = int(max(labels.max(), 0)) + 1
    both = np.where(labels >= 0, objects * np.int32(size) + labels, np.int32(IGNORED))
    pairs, keys, counts = labelled_voxels(points, both, _VOXEL)
    owners, names = np.divmod(pairs, size)
    voxels, ranks = np.unique(keys, return_inverse=True)
    places, of_place = np.unique(owners * max(len(voxels), 1) + ranks, return_inverse=True)
    sizes = np.bincount(of_place, counts, minlength=len(places)).astype(np.int64)
    most = counts > _MAJORITY * sizes[of_place]
    labelled = zip(keys[most].tolist(), owners[most].tolist(), names[most].tolist(), strict=True)
    owners, ranks = np.divmod(places, max(len(voxels), 1))
    return _Places(voxels[ranks], owners, sizes, list(labelled))


def corrected(known: Labels, given: Labels, wrong: list[tuple[int, int]]) -> Labels:
    """Return ``given`` with the labels in ``wrong`` replaced by what the map knows.

    Where the map knows nothing, a part of the label follows what it hangs together with, when that is
    clearly one object; else it becomes unknown.
    """
    out = given.copy()
    for m, label in wrong:
        out[(known == m) & (given == label)] = m
    for label in sorted({label for _, label in wrong}):
        parts = cv2.connectedComponents((given == label).astype(np.uint8), connectivity=4)[1]
        owners = _owners(parts, known)
        free = (parts > 0) & (known < 0)
        out[free] = owners[parts[free]]
    return out


def _owners(parts: NDArray[np.int32], known: Labels) -> Labels:
    """Return the object to which each part clearly belongs; -1: none, or several."""
    count = int(parts.max()) + 1
    owners = np.full(count, -1, np.int32)
    inside = (parts > 0) & (known >= 0)
    part, objects = parts[inside], known[inside]
    if part.size == 0:
        return owners
    classes = int(objects.max()) + 1
    table = np.bincount(part.astype(np.int64) * classes + objects, minlength=count * classes)
    table = table.reshape(count, classes)
    best = table.argmax(axis=1).astype(np.int32)
    clear = table.max(axis=1) > _CLEAR * table.sum(axis=1)
    return np.where(clear, best, owners)
