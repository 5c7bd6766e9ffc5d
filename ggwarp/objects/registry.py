# SPDX-License-Identifier: Apache-2.0
"""Object ids: the masks' own ids on one side, dense class indices on the other.

Masks may name objects by any non-negative integer; the classifier wants 0..classes-1. The
table grows with every new id, so that no id is dropped and no two ids are merged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NO_OBJECT = 0
"""The masks' id, and the class, of pixels that belong to no object."""

IGNORED = -1
"""Label of pixels that teach nothing."""


class ClassTable:
    """A one-to-one map between mask ids and dense class indices; class 0 is "no object"."""

    def __init__(self) -> None:
        self._ids = np.array([NO_OBJECT], np.int64)  # class index -> id
        self._lookup: dict[int, int] = {NO_OBJECT: 0}

    @property
    def count(self) -> int:
        """Classes so far, "no object" included."""
        return len(self._ids)

    @property
    def ids(self) -> NDArray[np.int64]:
        """[count] the masks' id of each class."""
        return self._ids

    def encode(self, mask: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the class of each pixel of ``mask`` [h, w], adding classes for new ids.

        Negative ids become :data:`IGNORED`.
        """
        present, inverse = np.unique(mask, return_inverse=True)
        classes = np.empty(len(present), np.int32)
        for i, raw in enumerate(present.tolist()):
            classes[i] = IGNORED if raw < 0 else self._class_of(raw)
        return classes[inverse].reshape(mask.shape)

    def decode(self, classes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the masks' ids of ``classes`` (any shape); ignored or unknown ones become 0."""
        known = (classes >= 0) & (classes < self.count)
        return np.where(known, self._ids[np.where(known, classes, 0)], NO_OBJECT).astype(np.int32)

    def find(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the class of each of ``ids`` (any shape); unknown ones become :data:`IGNORED`."""
        order = np.argsort(self._ids, kind="stable")
        at = np.minimum(np.searchsorted(self._ids[order], ids), self.count - 1)
        return np.where(self._ids[order][at] == ids, order[at], IGNORED).astype(np.int32)

    def _class_of(self, raw: int) -> int:
        if raw not in self._lookup:
            self._lookup[raw] = len(self._ids)
            self._ids = np.append(self._ids, raw)
        return self._lookup[raw]
