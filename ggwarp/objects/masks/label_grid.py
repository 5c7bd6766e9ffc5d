# SPDX-License-Identifier: Apache-2.0
"""Labels found at the pixels of a grid, given back to every pixel of the picture.

Which object a mask shows, where and under which id is a matter of areas, which a grid measures; borders are
the mask's own.
"""

from __future__ import annotations

import numpy as np

from ggwarp.geometry.distinct import ranked
from ggwarp.geometry.pixel_grid import PixelGrid
from ggwarp.objects.class_table import IGNORED
from ggwarp.objects.labels import Labels, contingency


def changed(grid: PixelGrid, whole: Labels, few: Labels) -> Labels:
    """Return labels ``whole`` [h, w], as ``few`` [gh, gw] has them in the blocks where these differ."""
    if grid.step == 1:
        return few
    rows, columns = np.nonzero(grid.thinned(whole) != few)
    if not len(rows):
        return whole
    out, labels = whole.copy(), few[rows, columns]
    # What is left over goes with the last block of a row or column.
    ends = [
        np.where(at == count - 1, size, np.minimum((at + 1) * grid.step, size))
        for at, count, size in zip((rows, columns), few.shape, whole.shape, strict=True)
    ]
    reach = grid.step + grid.step // 2
    down, right = np.divmod(np.arange(reach * reach), reach)
    y, x = rows[:, None] * grid.step + down, columns[:, None] * grid.step + right
    inside = (y < ends[0][:, None]) & (x < ends[1][:, None])
    out[y[inside], x[inside]] = np.broadcast_to(labels[:, None], y.shape)[inside]
    return out


def of_mask(grid: PixelGrid, few: Labels, mask: Labels) -> Labels:
    """Return the label [h, w] of every pixel of a mask, from those at the grid's.

    Args:
        grid: the pixels.
        few: [gh, gw] their labels.
        mask: [h, w] the mask's ids: a pixel has the label that most of its id's have, but in the blocks of
            grid pixels that have another.
    """
    if grid.step == 1:
        return few
    ids, ranks = ranked(grid.thinned(mask))
    known = np.maximum(few, IGNORED) - IGNORED
    size = max(len(ids), int(known.max()) + 1)
    usual = contingency(ranks.astype(np.int32), known, size)[: len(ids)]
    labels = usual.argmax(axis=1).astype(np.int32) + np.int32(IGNORED)
    return changed(grid, _looked_up(mask, ids, labels), few)


def _looked_up(mask: Labels, ids: Labels, labels: Labels) -> Labels:
    """Return the label of each id in ``mask``, by rising ``ids`` [k] and their ``labels``; ignored else."""
    least, most = int(ids[0]), int(ids[-1])
    if most - least < mask.size:
        table = np.full(most - least + 3, IGNORED, np.int32)  # the first and the last: of other ids
        table[ids - least + 1] = labels
        return table.take(mask - np.int32(least - 1), mode="clip")
    at = np.minimum(np.searchsorted(ids, mask), len(ids) - 1)
    return np.where(ids[at] == mask, labels[at], np.int32(IGNORED))
