# SPDX-License-Identifier: Apache-2.0
"""Small tools on label images: [h, w] int32 classes, negative = unknown."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Labels = NDArray[np.int32]
_STATISTICS = 50_000  # pixels that are enough to count over


def thinned(height: int, width: int) -> tuple[slice, slice]:
    """Return the pixels to count over in an image of this size: all of a small one, a grid of a large one."""
    step = max(1, int((height * width / _STATISTICS) ** 0.5))
    return slice(step // 2, None, step), slice(step // 2, None, step)


def contingency(rows: Labels, columns: Labels, classes: int) -> NDArray[np.int64]:
    """Return [classes, classes] how many pixels have label i in ``rows`` and j in ``columns``.

    Pixels unknown in either are left out.
    """
    both = (rows >= 0) & (columns >= 0)
    pairs = rows[both].astype(np.int64) * classes + columns[both]
    return np.bincount(pairs, minlength=classes * classes).reshape(classes, classes)


def filled(labels: Labels) -> Labels:
    """Return ``labels`` with the unknown pixels as their nearest known one; as they are if none is known."""
    unknown = labels < 0
    if not unknown.any() or unknown.all():
        return labels
    distances_and_nearest = cv2.distanceTransformWithLabels(
        unknown.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(distances_and_nearest[1], np.int32)
    table = np.zeros(int(nearest.max()) + 1, np.int32)
    table[nearest[~unknown]] = labels[~unknown]
    return np.where(unknown, table[nearest], labels)
