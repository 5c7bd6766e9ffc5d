# SPDX-License-Identifier: Apache-2.0
"""Whether ids are those of objects, or of a picture, or made by resizing."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.formats.mask_file import Ids

MOST_IDS = 4096
"""Most ids of one mask, and at most one per 20 pixels: a mask of more is a picture of something else."""
_ALWAYS_IDS = 256  # what 8 bits hold is never too much
_PIXELS_PER_ID = 20
_FEWEST_THIN, _SHARE_THIN = 4, 1 / 3
"""Ids without a pixel inside them, and how many for each other id, from which on masks were interpolated.

Masks of the built-in office and of Replica, 1200 to 150 pixels wide, have at most 0.19 such ids for each
other one; once enlarged or reduced by interpolation they have 0.47 (ids 1, 2, 3, ...) to 6."""


def interpolated(masks: Sequence[Ids]) -> str:
    """Say so where ``masks`` [h, w] look like the result of interpolation; empty: they do not."""
    thin, others = thin_ids(masks)
    if others < 2 or thin <= _FEWEST_THIN + _SHARE_THIN * others:
        return ""
    return (
        f"{thin} ids have no pixel inside them, {others} have: the masks were resized by interpolation? Ids "
        "along edges are left out; export them again with nearest neighbours"
    )


def without_edges(ids: Ids, void: int) -> Ids:
    """Return ``ids`` [h, w] with ``void`` wherever no 3x3 pixels round a pixel, or beside it, have its id."""
    solid = cv2.dilate(inside(ids).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.where(solid, ids, void).astype(np.int32)


def too_many_ids(ids: Ids) -> str:
    """Say so where a mask [h, w] holds more ids than a segmenter finds; empty: it does not."""
    most = max(_ALWAYS_IDS, min(MOST_IDS, ids.size // _PIXELS_PER_ID))
    if int(ids.max(initial=0)) < most:
        return ""
    present = np.zeros(int(ids.max()) + 1, np.bool_)
    present[ids] = True
    count = np.count_nonzero(present)
    return f"holds {count} ids, more than {most}: is it a picture of ids?" if count > most else ""


def inside(ids: Ids) -> NDArray[np.bool_]:
    """Return where all of a pixel's eight neighbours have its id."""
    values, window = ids.astype(np.float64), np.ones((3, 3), np.uint8)  # OpenCV has no 32-bit integers
    return np.equal(cv2.erode(values, window), cv2.dilate(values, window))


def thin_ids(masks: Sequence[Ids]) -> tuple[int, int]:
    """Return how many ids of ``masks`` have no pixel inside them anywhere, and how many have one."""
    present = {int(i) for ids in masks for i in np.unique(ids)}
    solid = {int(i) for ids in masks for i in np.unique(ids[inside(ids)])}
    return len(present - solid), len(solid)
