# SPDX-License-Identifier: Apache-2.0
"""All places of a run: where they are in memory, and what they show, mostly, in a file.

A search looks at what the last few places show and at seven earlier ones, wherever these are. What a place
shows, some 120 kB of features, a small picture and a thinned surface, is written and read in less than a
millisecond.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.pipeline.loops.features import Features
from ggwarp.pipeline.loops.places import Place, PlacePose
from ggwarp.pipeline.loops.surface_registration import Surface
from ggwarp.pipeline.tracking.relocalisation import SmallView, SmallViews
from ggwarp.runtime.image_store import ImageStore
from ggwarp.runtime.state import FrameSource, State, Stateful
from ggwarp.runtime.streams import to_host

_IN_MEMORY = 8_000_000
"""Bytes of what places show: those of about seventy, as many as seven searches look at."""

_FEATURES = ("pixels", "points", "descriptors")
_VIEW = ("grey", "depth")
_SURFACE = ("surface_points", "surface_quats", "surface_spreads")


class Places(Stateful):
    """Places, numbered in the order in which they came.

    Attributes:
        poses: where each is; whoever moves a place does it here.
    """

    STATE = ("poses", "_spacings", "_sizes")

    def __init__(self, pictures: SmallViews, folder: Callable[[], Path] | None) -> None:
        """Begin without any.

        Args:
            pictures: makes their small pictures.
            folder: tells where the file will be, when it is first needed; None: all stays in memory.
        """
        self._pictures = pictures
        budget = None if folder is None else _IN_MEMORY
        self._store = ImageStore(device="cpu", budget=budget, folder=folder, level=0)
        self.poses: list[PlacePose] = []
        self._spacings: list[float] = []
        self._sizes: list[tuple[int, int, int]] = []  # rows of features, of the small picture, of the surface

    def __len__(self) -> int:
        return len(self.poses)

    def add(self, place: Place) -> None:
        """Take in the next place."""
        features, view, surface = place.features, place.view, place.surface
        number = len(self)
        self._put(number, _FEATURES, (features.pixels, features.points, features.descriptors))
        self._put(number, _VIEW, (view.grey, view.depth))
        self._put(number, _SURFACE, (surface.points, surface.quats, surface.spreads))
        self.poses.append(PlacePose(place.index, place.T_wc, place.depth))
        self._spacings.append(surface.spacing)
        self._sizes.append((len(features), len(view.grey), len(surface.points)))

    def features(self, number: int) -> Features:
        """Return the features of a place's picture."""
        return Features(*(self._get(number, name) for name in _FEATURES))

    def descriptors(self, number: int) -> NDArray[np.uint8]:
        """Return [n, 128] those of its features alone."""
        return self._get(number, "descriptors")

    def view(self, number: int) -> SmallView:
        """Return a place's small picture."""
        return self._pictures.of(*(self._get(number, name) for name in _VIEW))

    def surface(self, number: int) -> Surface:
        """Return a place's thinned points."""
        return Surface(*(self._get(number, name) for name in _SURFACE), spacing=self._spacings[number])

    def state(self) -> State:
        """Return all of it; what is in the file is read when the state is written."""
        numbers = range(len(self))
        shown = {
            name: self._store.joined([(number, name) for number in numbers])
            for name in (*_FEATURES, *_VIEW, *_SURFACE)
            if numbers
        }
        return super().state() | {"shown": shown}

    def restore(self, state: State, frames: FrameSource) -> None:
        """Take all of it over."""
        super().restore(state, frames)
        self._store.clear()
        begins = (0, 0, 0)
        for number, sizes in enumerate(self._sizes):
            ends = tuple(begin + size for begin, size in zip(begins, sizes, strict=True))
            for names, begin, end in zip((_FEATURES, _VIEW, _SURFACE), begins, ends, strict=True):
                self._put(number, names, tuple(np.asarray(state["shown"][name])[begin:end] for name in names))
            begins = ends

    def _put(self, number: int, names: tuple[str, ...], arrays: tuple[NDArray[Any], ...]) -> None:
        for name, array in zip(names, arrays, strict=True):
            dtype = wp.dtype_from_numpy(array.dtype)
            self._store.put((number, name), wp.array(array, dtype=dtype, device="cpu"))

    def _get(self, number: int, name: str) -> NDArray[Any]:
        return to_host(self._store.get((number, name)))
