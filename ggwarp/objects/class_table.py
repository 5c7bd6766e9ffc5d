# SPDX-License-Identifier: Apache-2.0
"""Object ids: the masks' own ids on one side, dense class indices on the other.

Masks may name objects by any non-negative integer; the classifier wants 0..classes-1. The
table grows with every new id, so that no id is dropped. Two classes found to be one object are joined: they
go on as two for the classifier, and under one id for everyone else. An id found to stand for two objects
is one's name, and the other's source.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.objects.labels import ranked

NO_OBJECT = 0
"""The masks' id, and the class, of pixels that belong to no object."""

IGNORED = -1
"""Label of pixels that teach nothing."""


class ClassTable:
    """Mask ids, classes and the ids that objects go by; class 0 is "no object"."""

    def __init__(self) -> None:
        self._names = [NO_OBJECT]  # class -> the id it goes by; NO_OBJECT: none yet
        self._heads = [0]  # class -> the class that it was joined to, or itself
        self._lookup: dict[int, int] = {NO_OBJECT: 0}  # mask id -> class
        self._like: dict[int, int] = {}  # class -> the class whose mask id is its own, too

    @property
    def count(self) -> int:
        """Classes so far, "no object" included."""
        return len(self._names)

    @property
    def ids(self) -> NDArray[np.int64]:
        """[count] the id of each class's object: the masks' own, where they have one for it."""
        return np.array(self._names, np.int64)[self._heads]

    @property
    def mask_ids(self) -> frozenset[int]:
        """The ids that masks had, "no object" included; others were made up."""
        return frozenset(self._lookup)

    def encode(self, mask: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the class of each pixel of ``mask`` [h, w], adding classes for new ids.

        Negative ids become :data:`IGNORED`.
        """
        present, ranks = ranked(mask)
        classes = [IGNORED if raw < 0 else self._class_of(raw) for raw in present.tolist()]
        return self.joined(np.array(classes, np.int32))[ranks]

    def decode(self, classes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the ids of ``classes`` (any shape); ignored or unknown ones become 0."""
        known = (classes >= 0) & (classes < self.count)
        return np.where(known, self.ids[np.where(known, classes, 0)], NO_OBJECT).astype(np.int32)

    def joined(self, classes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return ``classes`` (any shape), each as the class that stands for its object."""
        heads = np.array([*self._heads, IGNORED], np.int32)
        return heads[classes]  # IGNORED is the last

    def begin(self, like: int | None = None) -> int:
        """Return a new class that no mask id stands for; it goes by "no object" until it is named.

        Args:
            like: the class whose mask id stands for the new one's object, too.
        """
        self._names.append(NO_OBJECT)
        self._heads.append(self.count - 1)
        if like is not None:
            self._like[self.count - 1] = like
        return self.count - 1

    def namesake_of(self, classes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return ``classes`` (any shape), each as the class that its mask id stands for."""
        table = np.arange(self.count + 1, dtype=np.int32)
        table[-1] = IGNORED
        for index, like in self._like.items():
            table[index] = like
        return self.joined(table[classes])

    def share_an_id(self, one: int, other: int) -> bool:
        """Whether a mask's id stands for the objects of both classes."""
        first, second = self.namesake_of(np.array([one, other], np.int32)).tolist()
        return first == second

    def name(self, index: int) -> int:
        """Give class ``index`` the lowest free id if it has none; return its id."""
        if self._names[index] == NO_OBJECT and index > 0:
            taken = {*self._names, *self._lookup}
            self._names[index] = next(i for i in range(1, len(taken) + 2) if i not in taken)
        return self._names[index]

    def join(self, kept: int, gone: int) -> None:
        """Let class ``gone``, and what was joined to it, stand for the object of class ``kept``.

        Raises:
            ValueError: one of them is "no object".
        """
        kept, old = self._heads[kept], self._heads[gone]
        if 0 in (kept, old):
            raise ValueError(f"classes {kept} and {gone}: no object is not joined to one")
        if self._names[kept] == NO_OBJECT:
            self._names[kept] = self._names[old]
        self._heads = [kept if head == old else head for head in self._heads]

    def sources(self) -> dict[int, tuple[int, ...]]:
        """Return id -> the mask ids that became it, where they are not itself alone."""
        found: dict[int, list[int]] = {}
        ids = self.ids.tolist()
        for raw, index in self._lookup.items():
            alike = [i for i, like in self._like.items() if self._heads[like] == self._heads[index]]
            for name in {ids[i] for i in (index, *alike)}:
                found.setdefault(name, []).append(raw)
        return {i: tuple(sorted(raws)) for i, raws in sorted(found.items()) if raws != [i]}

    def _class_of(self, raw: int) -> int:
        if raw not in self._lookup:
            others = [index for index, name in enumerate(self._names) if name == raw]
            self._lookup[raw] = self.begin()
            self._names[-1] = raw
            for index in others:  # named before the id was known to be a mask's
                self._names[index] = NO_OBJECT
                self.name(index)
        return self._lookup[raw]
