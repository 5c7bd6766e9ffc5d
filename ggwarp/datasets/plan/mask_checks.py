# SPDX-License-Identifier: Apache-2.0
"""Whether masks are of their pictures, tracked from frame to frame, and of objects alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.plan.correspondence import edges_of_labels, judge

Ids = NDArray[np.int32]

_FEWEST_IDS, _FEWEST_PAIRS = 4, 3
"""Ids of a frame, and pairs of neighbouring frames, that say whether ids stay."""
_RENAMED, _SAME = 0.6, 0.3
"""Share of pixels whose ids agree with the next frame's once those are renamed; and what of it must without.

Neighbouring frames of the built-in scenes and Replica's keyframes agree in 0.38 to 0.98 of the pixels, 0.65
to 1.0 of what renaming gives; ten frames apart, 0.38 of it; numbered anew in every frame, at most 0.17."""
_LARGEST_OF_BITS = (255, 65535)
_APART = 2
"""How many times larger than all other ids what means no label is."""


def mask_doubts(
    pictures: Mapping[int, NDArray[np.uint8]], masks: Mapping[int, Ids], *, tracked: bool = True
) -> Iterator[str]:
    """Yield what may be wrong with a sequence's masks.

    Args:
        pictures: index -> the picture [h, w, 3] of the frames to look at.
        masks: index -> the ids [h, w] of these and their neighbours, where there are any; 0 = no object.
        tracked: whether an id is to mean the same object in every frame.
    """
    if doubt := judge(pictures, {index: edges_of_labels(ids) for index, ids in masks.items()}, "mask"):
        yield doubt
    pairs = [(masks[i], masks[i + 1]) for i in pictures if i in masks and i + 1 in masks]
    if tracked and not _stay(pairs):
        yield (
            "ids change from frame to frame though the masks do not: are they numbered anew in each? "
            "--masks-kind untracked takes them so"
        )
    present = sorted({int(id) for i in pictures if i in masks for id in np.unique(masks[i]) if id > 0})
    if len(present) > 2 and present[-1] in _LARGEST_OF_BITS and present[-1] > _APART * present[-2]:
        yield (
            f"id {present[-1]} stands beside ids up to {present[-2]}: does it mean no label? "
            f"--masks-void {present[-1]} leaves it out"
        )


def _stay(pairs: list[tuple[Ids, Ids]]) -> bool:
    """Return whether ids of neighbouring frames' masks agree as they are, as far as these tell."""
    votes = [vote for vote in (_renamed(*pair) for pair in pairs) if vote is not None]
    return len(votes) < _FEWEST_PAIRS or 2 * sum(votes) <= len(votes)


def _renamed(ids: Ids, after: Ids) -> bool | None:
    """Return whether ``after`` agrees with ``ids`` [h, w] under other ids only; None: that is not told."""
    both = (ids > 0) & (after > 0)
    if ids.shape != after.shape or not both.any():
        return None
    names, here = np.unique(ids[both], return_inverse=True)
    others, there = np.unique(after[both], return_inverse=True)
    if min(len(names), len(others)) < _FEWEST_IDS:
        return None
    counts = np.bincount(here * len(others) + there, minlength=len(names) * len(others))
    renamed = counts.reshape(len(names), len(others)).max(axis=1).sum() / len(here)
    same = float(np.mean(ids[both] == after[both]))
    return None if renamed < _RENAMED else same < _SAME * renamed
