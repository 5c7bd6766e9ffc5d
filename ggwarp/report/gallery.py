# SPDX-License-Identifier: Apache-2.0
"""``pictures/``: some frames as people look at them, and each object where it is seen best.

``frame%06d_{frame,render,difference,depth,objects}.jpg`` and ``object%06d.jpg``; the exact values are in
``renders/``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ggwarp.geometry.distinct import ranked
from ggwarp.io.atomic import atomic_write
from ggwarp.report.colours import (
    Picture,
    depth_in_colours,
    depth_limits,
    difference,
    jpeg,
    objects_in_colours,
    shrunk,
    to_bytes,
)
from ggwarp.types import Float32, Frame, Rendered

FOLDER = "pictures"
KINDS = ("frame", "render", "difference", "depth", "objects")
"""The pictures of a frame."""

_FRAMES = 10
_WIDTH = 480
_CROP = 112  # pixels of an object's longer side
_MARGIN = 0.15  # of an object's size, round it
_CUT = 0.25  # what a view counts whose border cuts the object
_LEAST_AREA = 30  # pixels
_NAME = re.compile(r"frame(\d+)_(\w+)\.jpg")
_OBJECT = re.compile(r"object(\d+)\.jpg")


class Gallery:
    """Gathers pictures while frames are compared, a few hundred kilobytes in all.

    ``frames`` are spread evenly over the run; the one that is fitted worst comes on top.
    """

    def __init__(self, indices: Sequence[int]) -> None:
        """Prepare for the frames ``indices``, in order."""
        step = max(1, -(-len(indices) // _FRAMES))
        self._chosen = set(indices[::step])
        self._frames: dict[int, dict[str, bytes]] = {}
        self._worst: tuple[float, int, dict[str, bytes]] | None = None
        self._objects: dict[int, tuple[float, Picture]] = {}

    def add(self, frame: Frame, view: Rendered, psnr: float | None) -> None:
        """Look at a frame and the map's ``view`` of it."""
        if frame.index in self._chosen:
            self._frames[frame.index] = _pictures(frame, view)
        elif psnr is not None and (self._worst is None or psnr < self._worst[0]):
            self._worst = (psnr, frame.index, _pictures(frame, view))
        if view.objects is not None:
            self._keep_objects(view.objects, view.rgb)

    def write(self, folder: Path) -> None:
        """Write ``pictures/`` into the run ``folder``.

        Raises:
            OSError: a file cannot be written.
        """
        (folder / FOLDER).mkdir(exist_ok=True)
        frames = dict(self._frames)
        if self._worst is not None:
            frames[self._worst[1]] = self._worst[2]
        for index, pictures in frames.items():
            for kind, data in pictures.items():
                _save(folder / FOLDER / f"frame{index:06d}_{kind}.jpg", data)
        for identifier, (_, crop) in self._objects.items():
            _save(folder / FOLDER / f"object{identifier:06d}.jpg", jpeg(crop))

    def _keep_objects(self, ids: np.ndarray, rgb: Float32) -> None:
        """Keep the objects that this view shows larger than any before."""
        for identifier, (rows, columns, area) in _boxes(ids).items():
            whole = rows[0] > 0 and columns[0] > 0 and rows[1] < ids.shape[0] and columns[1] < ids.shape[1]
            value = area if whole else _CUT * area
            if value > max(self._objects.get(identifier, (0.0,))[0], _LEAST_AREA):
                self._objects[identifier] = (value, _crop(rgb, rows, columns))


def read_gallery(folder: Path) -> tuple[dict[int, dict[str, Path]], dict[int, Path]]:
    """Return what ``pictures/`` of the run in ``folder`` holds: index -> kind -> file, and id -> file."""
    frames: dict[int, dict[str, Path]] = {}
    objects: dict[int, Path] = {}
    for path in sorted((folder / FOLDER).glob("*.jpg")) if (folder / FOLDER).is_dir() else ():
        if match := _NAME.fullmatch(path.name):
            frames.setdefault(int(match[1]), {})[match[2]] = path
        elif match := _OBJECT.fullmatch(path.name):
            objects[int(match[1])] = path
    return dict(sorted(frames.items())), objects


def _pictures(frame: Frame, view: Rendered) -> dict[str, bytes]:
    depth = view.surface_depth
    pictures = {
        "frame": frame.rgb,
        "render": to_bytes(view.rgb),
        "difference": difference(view.rgb, frame.rgb),
        "depth": depth_in_colours(depth, depth_limits(depth)),
    }
    if view.objects is not None:
        pictures["objects"] = objects_in_colours(view.objects, view.rgb)
    return {kind: jpeg(shrunk(picture, _WIDTH)) for kind, picture in pictures.items()}


def _boxes(ids: np.ndarray) -> dict[int, tuple[tuple[int, int], tuple[int, int], float]]:
    """Return id -> its rows, columns (begin, end) and pixels."""
    from scipy.ndimage import find_objects  # heavy, and not needed before a run has ended

    known, numbers = ranked(ids)
    areas = np.bincount(numbers.ravel(), minlength=len(known)).tolist()
    places = find_objects(numbers.astype(np.int32) + 1, max_label=len(known))
    return {
        identifier: ((rows.start, rows.stop), (columns.start, columns.stop), float(area))
        for identifier, (rows, columns), area in zip(known.tolist(), places, areas, strict=True)
        if identifier > 0 and area >= _LEAST_AREA
    }


def _crop(rgb: Float32, rows: tuple[int, int], columns: tuple[int, int]) -> Picture:
    margin = round(_MARGIN * max(rows[1] - rows[0], columns[1] - columns[0])) + 2
    top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
    part = to_bytes(rgb[top : rows[1] + margin, left : columns[1] + margin])
    height, width = part.shape[:2]
    return np.ascontiguousarray(shrunk(part, round(_CROP * min(1.0, width / height)) or 1))


def _save(path: Path, data: bytes) -> None:
    with atomic_write(path) as file:
        file.write(data)
