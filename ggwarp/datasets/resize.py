# SPDX-License-Identifier: Apache-2.0
"""Resampling that respects what a pixel means: a label is not averaged, nor depth across an edge."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float32

_PLACES = 4
"""Places along a side at which a footprint of labels is looked at."""
_AGREEMENT = 0.02
"""Readings agree when max - min is below this share of their mean."""


def resize_nearest(image: NDArray, width: int, height: int) -> NDArray:
    """Return ``image`` [h, w] resampled to [height, width] by nearest pixel centre."""
    rows = ((np.arange(height) + 0.5) * image.shape[0] / height).astype(np.intp)
    columns = ((np.arange(width) + 0.5) * image.shape[1] / width).astype(np.intp)
    return image[rows[:, None], columns]


def resize_labels(labels: NDArray[np.int32], width: int, height: int) -> NDArray[np.int32]:
    """Return ``labels`` [H, W] resampled to [height, width]: where it shrinks, what fills most of each pixel.

    A footprint is looked at in 4 x 4 places. Of labels that fill as much of it, the upper left and the lower
    right are taken in turn, so that no border moves: no pixel of an even footprint is its middle.
    """
    if labels.shape == (height, width):
        return labels
    if labels.shape[0] <= height or labels.shape[1] <= width:
        return resize_nearest(labels, width, height)
    places = (np.arange(_PLACES) + 0.5) / _PLACES
    rows = ((np.arange(height)[:, None] + places) * labels.shape[0] / height).astype(np.intp)
    columns = ((np.arange(width)[:, None] + places) * labels.shape[1] / width).astype(np.intp)
    corner = labels[rows[:, :1], columns[:, 0]]
    mixed = np.zeros(corner.shape, np.bool_)
    for i in range(_PLACES):
        for j in range(_PLACES):
            mixed |= labels[rows[:, i, None], columns[:, j]] != corner
    out = corner.copy()
    y, x = np.nonzero(mixed)
    if len(y):
        found = labels[rows[y][:, :, None], columns[x][:, None, :]].reshape(len(y), -1)
        votes = (found[:, :, None] == found[:, None, :]).sum(axis=2)
        first = votes.argmax(axis=1)
        last = votes.shape[1] - 1 - votes[:, ::-1].argmax(axis=1)
        chosen = np.where((y + x) % 2 == 0, first, last)
        out[y, x] = found[np.arange(len(y)), chosen]
    return out


def reduce_depth(depth: Float32, width: int, height: int) -> Float32:
    """Return ``depth`` reduced to [height, width], never mixing two surfaces.

    A target pixel is the area-weighted mean of the valid readings that its footprint touches where
    these agree to 2 %; where they do not, it is the valid one nearest to the footprint's centre.

    Args:
        depth: [H, W] metres, 0 = no reading; height <= H, width <= W.

    Returns:
        [height, width] metres, 0 where the footprint has no reading.
    """
    if depth.shape == (height, width):
        return depth
    rows, columns = _footprints(depth.shape[0], height), _footprints(depth.shape[1], width)
    valid = depth > 0.0
    weight = cv2.resize(valid.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    total = cv2.resize(depth, (width, height), interpolation=cv2.INTER_AREA)
    out = np.divide(total, weight, out=np.zeros((height, width), np.float32), where=weight > 0.0)
    highest = _over_footprints(np.maximum, depth, rows, columns)
    lowest = _over_footprints(np.minimum, np.where(valid, depth, np.float32(np.inf)), rows, columns)
    y, x = np.nonzero(highest - lowest >= _AGREEMENT * np.maximum(out, np.float32(1e-6)))
    if len(y):
        out[y, x] = _nearest_to_centre(depth, rows[y], columns[x])
    return out


def _footprints(size: int, target: int) -> NDArray[np.intp]:
    """Return [target, 2] the half-open range of source pixels that each target pixel touches."""
    first = np.arange(target) * size // target
    end = -(-(np.arange(target) + 1) * size // target)
    return np.stack([first, end], axis=1)


def _over_footprints(
    ufunc: np.ufunc, image: Float32, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> Float32:
    """Return ``ufunc`` (maximum or minimum) of ``image`` over every footprint."""
    for axis, ranges in ((0, rows), (1, columns)):
        image_out = image.take(ranges[:, 0], axis=axis)
        for step in range(1, (ranges[:, 1] - ranges[:, 0]).max()):
            inside = np.minimum(ranges[:, 0] + step, ranges[:, 1] - 1)
            ufunc(image_out, image.take(inside, axis=axis), out=image_out)
        image = image_out
    return image


def _nearest_to_centre(depth: Float32, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Float32:
    """Return the valid reading nearest to the centre of each footprint, rows x columns [n, 2] each."""
    centre_v, centre_u = (rows.sum(axis=1) - 1) / 2, (columns.sum(axis=1) - 1) / 2
    best = np.full(len(rows), np.inf)
    out = np.zeros(len(rows), np.float32)
    for i in range((rows[:, 1] - rows[:, 0]).max()):
        v = np.minimum(rows[:, 0] + i, rows[:, 1] - 1)
        for j in range((columns[:, 1] - columns[:, 0]).max()):
            u = np.minimum(columns[:, 0] + j, columns[:, 1] - 1)
            reading = depth[v, u]
            distance = (v - centre_v) ** 2 + (u - centre_u) ** 2
            closer = (reading > 0.0) & (distance < best)
            best[closer] = distance[closer]
            out[closer] = reading[closer]
    return out


def sample_depth(depth: Float32, u: Float32, v: Float32) -> Float32:
    """Return ``depth`` at positions between pixels, never mixing two surfaces.

    Between four valid readings that agree to 2 %, or differ as a slanted surface beside them does, inverse
    depth is bilinear, as on any plane; else it is the nearest pixel's.

    Args:
        depth: [H, W] metres, 0 = no reading.
        u, v: [h, w] columns and rows in ``depth``; integers are pixel centres.

    Returns:
        [h, w] metres; 0 = no reading, or outside.
    """
    # Of the four pixels whose top left one this is; 0, no reading, is the lowest and agrees with none.
    lowest, highest = _of_four(np.minimum, depth), _of_four(np.maximum, depth)
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
    agree = (highest - lowest < _AGREEMENT * lowest) | _slanted(inverse)
    constant = cv2.BORDER_CONSTANT
    nearest = cv2.remap(depth, u, v, cv2.INTER_NEAREST, borderMode=constant)
    between = cv2.remap(inverse, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    left, top = np.floor(u).astype(np.float32), np.floor(v).astype(np.float32)
    good = cv2.remap(agree.astype(np.uint8), left, top, cv2.INTER_NEAREST, borderMode=constant)
    linear = (good > 0) & (nearest > 0.0) & (between > 0.0)
    return np.divide(1.0, between, out=nearest, where=linear)


def _slanted(inverse: Float32) -> NDArray[np.bool_]:
    """Return [H, W] whether the four pixels whose top left one this is lie on the slope of those beside them.

    Args:
        inverse: [H, W] inverse depth, which is linear on a plane; 0 = no reading.
    """
    across, down = _continued(inverse), _continued(inverse.T).T
    out = np.zeros(inverse.shape, np.bool_)
    out[:-1, :-1] = across[:-1] & across[1:] & down[:, :-1] & down[:, 1:]
    return out


def _continued(inverse: Float32) -> NDArray[np.bool_]:
    """Return [H, W - 1] whether the step to the next pixel in a row is that before or after it, to 2 %."""
    bend = np.abs(np.diff(inverse, n=2, axis=1))
    before = np.pad(bend, ((0, 0), (1, 0)), constant_values=np.inf)
    after = np.pad(bend, ((0, 0), (0, 1)), constant_values=np.inf)
    return np.minimum(before, after) < _AGREEMENT * np.minimum(inverse[:, :-1], inverse[:, 1:])


def _of_four(ufunc: np.ufunc, image: Float32) -> Float32:
    right = ufunc(image, np.concatenate([image[:, 1:], image[:, -1:]], axis=1))
    return ufunc(right, np.concatenate([right[1:], right[-1:]], axis=0))


def enlarge_depth(depth: Float32, width: int, height: int) -> Float32:
    """Return ``depth`` [H, W] metres of the same view at [height, width], by :func:`sample_depth`."""
    if depth.shape == (height, width):
        return depth
    u = (np.arange(width, dtype=np.float32) + 0.5) * (depth.shape[1] / width) - 0.5
    v = (np.arange(height, dtype=np.float32) + 0.5) * (depth.shape[0] / height) - 0.5
    # The outermost half pixel repeats the border.
    u, v = np.clip(u, 0, depth.shape[1] - 1), np.clip(v, 0, depth.shape[0] - 1)
    return sample_depth(depth, *np.meshgrid(u.astype(np.float32), v.astype(np.float32)))
