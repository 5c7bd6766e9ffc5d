# SPDX-License-Identifier: Apache-2.0
"""A small picture of each object, from the view that shows most of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.editing.map_view import MapView
from ggwarp.editing.pictures import as_bytes, lit
from ggwarp.geometry.camera import Camera
from ggwarp.results.saved_run import SavedRun
from ggwarp.types import Float32

WIDTH, HEIGHT = 240, 160
"""Pixels: what the page's column is wide, so that nothing is enlarged."""
_VIEWS = 24  # of the run's poses that are looked at
_MARGIN = 0.25  # round an object, of its size
_LEAST = 8  # pixels
_LIT = 0.6  # brightness of what is round it, towards its own


def thumbnails(run: SavedRun, *, device: Any = "cpu") -> Iterator[tuple[int, NDArray[np.uint8]] | None]:
    """Yield the id of each object of ``run`` and its picture [HEIGHT, WIDTH, 3], all else darker.

    Objects that none of the views shows are left out; before the first, None is yielded after each
    view that was looked at.
    """
    ids = run.gaussians.object_ids
    if ids is None or not len(run.gaussians):
        return
    view = MapView(run.gaussians, run.camera, device=device)
    rows = np.unique(np.linspace(0, len(run.poses) - 1, _VIEWS).astype(int))
    named = np.array([record.id for record in run.objects], int)
    areas = np.zeros((len(rows), len(named)), np.float32)
    everywhere = np.ones((run.camera.height, run.camera.width), bool)
    known, inverse = np.unique(ids, return_inverse=True)
    for k, row in enumerate(rows.tolist()):
        weights = view.weights(run.poses[row], everywhere)[0]
        shares = np.bincount(inverse, weights=weights, minlength=len(known))
        areas[k] = [shares[known == i].sum() for i in named]
        yield None
    for number, identifier in enumerate(named.tolist()):
        best = int(areas[:, number].argmax())
        if areas[best, number] < _LEAST:
            continue
        T_wc = run.poses[rows[best]]
        own = ids == identifier
        close = view.through(_closer(run.camera, view.coverage(T_wc, own)[0]))
        rgb, coverage = close.render(T_wc).rgb, close.coverage(T_wc, own)[0]
        picture = np.float32(_LIT) * rgb + np.float32(1.0 - _LIT) * lit(rgb, coverage)
        yield identifier, as_bytes(np.asarray(picture, np.float32))


def _closer(camera: Camera, coverage: Float32) -> Camera:
    """Return the camera at the same place that sees what is covered, and some round it, as a thumbnail."""
    height, width = coverage.shape
    rows, columns = np.nonzero(coverage > 0.3 * coverage.max())
    size = max(float(np.ptp(columns)) + 1.0, (float(np.ptp(rows)) + 1.0) * WIDTH / HEIGHT)
    size = min(size * (1.0 + 2.0 * _MARGIN), float(width), height * WIDTH / HEIGHT)
    half_x, half_y = 0.5 * size, 0.5 * size * HEIGHT / WIDTH
    x = float(np.clip(0.5 * (columns.min() + columns.max()), half_x - 0.5, max(half_x, width - half_x) - 0.5))
    y = float(np.clip(0.5 * (rows.min() + rows.max()), half_y - 0.5, max(half_y, height - half_y) - 0.5))
    scale = WIDTH / size
    cx, cy = scale * (camera.cx - x + half_x) - 0.5, scale * (camera.cy - y + half_y) - 0.5
    return Camera(WIDTH, HEIGHT, scale * camera.fx, scale * camera.fy, cx, cy)
