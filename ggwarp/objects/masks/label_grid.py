# SPDX-License-Identifier: Apache-2.0
"""Labels found at the pixels of a grid, given back to every pixel of the picture, on the device.

Which object a mask shows, where and under which id is a matter of areas, which a grid measures; borders are
the mask's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry.distinct import ranked
from ggwarp.geometry.pixel_grid import PixelGrid
from ggwarp.kernels.identity.label_pictures import spread_labels
from ggwarp.objects.class_table import IGNORED, ClassTable
from ggwarp.objects.labels import Labels, as_runs, contingency, ends_of_runs, from_runs, packed_runs, runs_of
from ggwarp.runtime.state import state_value

_MOST_IDS = 65535
"""Ids above are numbered by rank: a table of them all would be long, and runs have 16 bits."""


@dataclass(frozen=True)
class MaskLabels:
    """The label of every pixel of a picture, by its mask and a grid.

    Attributes:
        mask: [2, r] small ids as :func:`ggwarp.objects.labels.as_runs` has them; None: there is no mask.
        usual: [k] the label that ids from -1 on usually have; the last is for those beyond, too.
        votes: [gh, gw] the labels of the grid's pixels.
    """

    mask: NDArray[np.uint16] | None
    usual: Labels
    votes: Labels

    @staticmethod
    def of(grid: PixelGrid, votes: Labels, mask: Labels | None) -> MaskLabels:
        """Find out which label the ids of ``mask`` [h, w] usually have, by those of the grid's pixels."""
        nothing = np.full(2, IGNORED, np.int32)
        if mask is None or grid.step == 1:
            return MaskLabels(None, nothing, votes)
        few = grid.thinned(mask)
        values, lengths = runs_of(mask)
        if values.min() < -1 or values.max() >= _MOST_IDS:
            distinct, ranks = ranked(values)
            values, few = ranks.astype(np.int32), np.searchsorted(distinct, few)
        ids, ranks = ranked(few)
        known = np.maximum(votes, IGNORED) - IGNORED
        size = max(len(ids), int(known.max()) + 1)
        labels = contingency(ranks.astype(np.int32), known, size)[: len(ids)].argmax(axis=1) + IGNORED
        usual = np.full(int(ids[-1]) + 3, IGNORED, np.int32)  # from -1 to one more than the largest
        usual[ids + 1] = labels
        return MaskLabels(packed_runs(values, lengths), usual, votes)


@state_value
@dataclass(frozen=True)
class PackedLabels:
    """:class:`MaskLabels` in little memory: ``votes``, too, as runs."""

    mask: NDArray[np.uint16] | None
    usual: Labels
    votes: NDArray[np.uint16]

    @staticmethod
    def of(labels: MaskLabels) -> PackedLabels:
        """Pack ``labels``."""
        return PackedLabels(labels.mask, labels.usual, as_runs(labels.votes))

    def unpacked(self, shape: tuple[int, ...], classes: ClassTable) -> MaskLabels:
        """Return the labels again, those of ``classes`` merged since as one; ``shape``: the grid's."""
        return MaskLabels(self.mask, classes.merged(self.usual), from_runs(self.votes, shape, classes.merged))


class LabelPictures:
    """Makes pictures of labels, on a device."""

    def __init__(self, grid: PixelGrid, *, device: Any) -> None:
        """Prepare for labels at the pixels of ``grid``."""
        self._grid, self._device = grid, device

    def changed(
        self,
        labels: MaskLabels,
        shape: tuple[int, int],
        one: Labels,
        other: Labels | None = None,
        *,
        without: NDArray[np.bool_] | None = None,
    ) -> tuple[Any, Any, Any]:
        """Return ``labels`` of all pixels, as they are, as ``one`` and as ``other`` [gh, gw] have them.

        All are [h, w] int on the device. Others count in the blocks where they differ from the votes.
        Without ``other`` only the second is made.

        Args:
            shape: height and width of the pictures.
            without: [h, w] where the second says nothing; None: nowhere.
        """
        if without is not None and self._grid.step == 1:
            one = np.where(without, np.int32(IGNORED), one)
        few = [labels.votes, one, other]
        wanted = [other is not None, True, other is not None]
        grids = [None if image is None else self._uploaded(image) for image in few]
        if self._grid.step == 1:
            first, second, third = (g if w else None for g, w in zip(grids, wanted, strict=True))
            return first, second, third
        first, second, third = (
            wp.empty(shape, dtype=int, device=self._device) if w else None for w in wanted
        )
        spread_labels(
            step=self._grid.step,
            mask=(None, None, None) if labels.mask is None else self._runs(labels.mask, shape),
            usual=self._uploaded(labels.usual),
            few=grids[0],
            out=first,
            others=(grids[1], grids[2]),
            without=None if without is None else wp.array(without, dtype=wp.uint8, device=self._device),
            out_others=(second, third),
            shape=shape,
            device=self._device,
        )
        return first, second, third

    def _runs(self, mask: NDArray[np.uint16], shape: tuple[int, int]) -> tuple[Any, Any, Any]:
        """Return the runs of a ``mask`` of ``shape`` on the device: ids, ends, and each row's first."""
        ends = ends_of_runs(mask, shape)
        first = np.searchsorted(ends, np.arange(shape[0]) * shape[1], side="right")
        ids = wp.array(mask[0], dtype=wp.uint16, device=self._device)
        return ids, self._uploaded(ends.astype(np.int32)), self._uploaded(first.astype(np.int32))

    def _uploaded(self, image: Labels) -> Any:
        return wp.array(image, dtype=int, device=self._device)
