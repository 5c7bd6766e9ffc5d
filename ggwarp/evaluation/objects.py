# SPDX-License-Identifier: Apache-2.0
"""How well rendered object ids agree with the masks: mean IoU and pixel accuracy.

Counts are summed over the whole sequence, object by object, before any ratio is taken. Every
labelled pixel counts; "no object" (id 0) is not itself averaged, but an object painted over it
loses, and so does one that is missing. Negative ids are unlabelled pixels.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int32]


class ObjectScore:
    """Per-object intersections and unions, summed over images."""

    def __init__(self) -> None:
        self._both: Counter[int] = Counter()
        self._true: Counter[int] = Counter()
        self._predicted: Counter[int] = Counter()
        self._pixels = 0

    def add(self, predicted: Ids, true: Ids) -> None:
        """Count one image: ``predicted`` and ``true`` [h, w] object ids, 0 = no object."""
        labelled = true >= 0
        predicted, true = predicted[labelled], true[labelled]
        self._pixels += true.size
        for counter, ids in (
            (self._both, true[predicted == true]),
            (self._true, true),
            (self._predicted, predicted),
        ):
            values, counts = np.unique(ids, return_counts=True)
            counter.update(dict(zip(values.tolist(), counts.tolist(), strict=True)))

    def __add__(self, other: ObjectScore) -> ObjectScore:
        """Return the counts of both."""
        total = ObjectScore()
        total._both = self._both + other._both
        total._true = self._true + other._true
        total._predicted = self._predicted + other._predicted
        total._pixels = self._pixels + other._pixels
        return total

    def iou(self) -> dict[int, float]:
        """Return the intersection over union of every object that the masks show."""
        return {
            i: self._both[i] / (self._true[i] + self._predicted[i] - self._both[i])
            for i in sorted(self._true)
            if i > 0
        }

    def mean_iou(self) -> float | None:
        """Return the mean over the masks' objects; None when they show none."""
        values = list(self.iou().values())
        return float(np.mean(values)) if values else None

    def accuracy(self) -> float | None:
        """Return the share of labelled pixels with the right id; None when there are none."""
        return sum(self._both.values()) / self._pixels if self._pixels else None
