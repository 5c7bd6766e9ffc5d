# SPDX-License-Identifier: Apache-2.0
"""A picture of a few frames: colour, depth in colours, depth's edges on the colour, masks."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.plan.correspondence import edges_of_depth
from ggwarp.types import Float32, Frame

_WIDTH = 320
"""Pixels of a picture on the sheet."""
_GAP = 4
_GOLDEN = 0.618034
"""Of the circle of hues, from an id to the next: neighbours differ, and none comes again soon."""

Picture = NDArray[np.uint8]


def contact_sheet(frames: Sequence[Frame]) -> Picture:
    """Return a sheet [h, w, 3] uint8 RGB with a row for each of ``frames``, which are one at least.

    Depth is coloured from the nearest hundredth (red) to the farthest (blue) of all readings; black
    is no reading. Where depth belongs to colour, its edges (red, on the third picture) lie on objects'.
    """
    height, width = frames[0].rgb.shape[:2]
    size = (_WIDTH, max(1, round(height * _WIDTH / width)))
    images = [frame.depth for frame in frames if frame.depth is not None]
    readings = np.concatenate([image[image > 0.0][::17] for image in images]) if images else np.zeros(0)
    limits = np.percentile(readings, (1, 99)) if len(readings) else np.array([0.0, 1.0])
    with_masks = any(frame.mask is not None for frame in frames)
    rows = []
    for frame in frames:
        rgb = _fitted(frame.rgb, size, cv2.INTER_AREA)
        row = [rgb]
        if images:
            row += [_depth_in_colours(frame.depth, limits, size), _with_edges(rgb, frame.depth)]
        if with_masks:
            row.append(_mask_in_colours(frame.mask, size))
        rows.append(np.concatenate([_framed(picture) for picture in row], axis=1))
    return np.concatenate(rows, axis=0)


def _fitted(image: NDArray, size: tuple[int, int], interpolation: int) -> NDArray:
    return np.asarray(cv2.resize(image, size, interpolation=interpolation))


def _framed(picture: Picture) -> Picture:
    return np.pad(picture, ((0, _GAP), (0, _GAP), (0, 0)), constant_values=255)


def _blank(size: tuple[int, int]) -> Picture:
    return np.zeros((size[1], size[0], 3), np.uint8)


def _depth_in_colours(depth: Float32 | None, limits: NDArray, size: tuple[int, int]) -> Picture:
    if depth is None:
        return _blank(size)
    small = _fitted(depth, size, cv2.INTER_NEAREST)
    near, far = float(limits[0]), max(float(limits[1]), float(limits[0]) + 1e-3)
    level = 255.0 * (1.0 - np.clip((small - near) / (far - near), 0.0, 1.0))
    colours = cv2.cvtColor(cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    return np.where((small > 0.0)[..., None], colours, 0).astype(np.uint8)


def _with_edges(rgb: Picture, depth: Float32 | None) -> Picture:
    shown = rgb.copy()
    if depth is not None:
        edges = _fitted(
            edges_of_depth(depth).astype(np.uint8), (rgb.shape[1], rgb.shape[0]), cv2.INTER_NEAREST
        )
        shown[edges > 0] = (255, 0, 0)
    return shown


def _mask_in_colours(mask: NDArray[np.int32] | None, size: tuple[int, int]) -> Picture:
    if mask is None:
        return _blank(size)
    small = _fitted(mask, size, cv2.INTER_NEAREST)
    hues = (small.astype(np.float64) * _GOLDEN) % 1.0 * 179.0
    hsv = np.stack([hues, np.full(small.shape, 180.0), np.full(small.shape, 235.0)], axis=-1).astype(np.uint8)
    return np.where((small > 0)[..., None], cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), 0).astype(np.uint8)
