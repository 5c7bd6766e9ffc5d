# SPDX-License-Identifier: Apache-2.0
"""Object ids: the masks' own ids on one side, dense class indices on the other.

Masks may name objects by any non-negative integer; the classifier wants 0..classes-1. The table grows
with every new id, up to more than any room holds. Two classes found to be one object are merged: they
go on as two for the classifier, and under one id for everyone else. When an id is found to stand for two
objects, it stays the id of one of them, and the other gets an id of its own. Objects of an earlier map keep
their ids: masks of another recording may mean something else by them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.distinct import ranked
from ggwarp.runtime.state import Stateful

log = logging.getLogger(__name__)

NO_OBJECT = 0
"""The masks' id, and the class, of pixels that belong to no object."""

IGNORED = -1
"""Label of pixels that say nothing."""


MOST_CLASSES = 8192
"""Most classes of a run: an id costs memory (about 45 kB) and time, whoever drew it."""


class ClassTable(Stateful):
    """Mask ids, classes and the ids that objects go by; class 0 is "no object"."""

    STATE = ("_ids", "_merged_into", "_class_of_id", "_shares_id_of", "_earlier", "_warned")

    def __init__(self) -> None:
        self._ids = [NO_OBJECT]  # class -> the id it goes by; NO_OBJECT: none yet
        self._merged_into = [0]  # class -> the class that it was merged into, or itself
        self._class_of_id: dict[int, int] = {NO_OBJECT: 0}  # mask id -> class
        self._shares_id_of: dict[int, int] = {}  # class -> the class whose mask id stands for it, too
        self._earlier = 1  # the first classes: "no object", and those of an earlier map
        self._warned = False

    def adopt(self, ids: Sequence[int]) -> None:
        """Begin with the objects ``ids`` of an earlier map, a class each, before any mask is seen."""
        self._ids += ids
        self._merged_into = list(range(self.count))
        self._earlier = self.count

    @property
    def earlier(self) -> int:
        """Classes that an earlier map had, "no object" included; they come first."""
        return self._earlier

    def knows(self, raw: int) -> bool:
        """Return whether mask id ``raw`` has a class."""
        return raw in self._class_of_id

    def recognise(self, raw: int, index: int) -> None:
        """Take mask id ``raw``, which is new, for the object of class ``index``."""
        self._class_of_id[raw] = index

    @property
    def count(self) -> int:
        """Classes so far, "no object" included."""
        return len(self._ids)

    @property
    def full(self) -> bool:
        """Whether there is no room for another class; said once."""
        if self.count >= MOST_CLASSES:
            self._warn_full()
        return self.count >= MOST_CLASSES

    @property
    def ids(self) -> NDArray[np.int64]:
        """[count] the id of each class's object: the masks' own, where they have one for it."""
        return np.array(self._ids, np.int64)[self._merged_into]

    def named(self, names: dict[int, str]) -> dict[int, str]:
        """Return id -> name, where ``names`` are by mask id: of several that are one object, its own."""
        ids, found = self.ids, dict[int, str]()
        both = sorted(names.keys() & self._class_of_id.keys())
        known = {raw: int(ids[self._class_of_id[raw]]) for raw in both}
        for raw, identifier in sorted(known.items(), key=lambda pair: pair[0] != pair[1]):
            found.setdefault(identifier, names[raw])
        return found

    def encode(self, mask: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the class of each pixel of ``mask`` [h, w], adding classes for new ids.

        Negative ids become :data:`IGNORED`, and so do new ones once there are :data:`MOST_CLASSES` classes.
        """
        ids, ranks = ranked(mask)
        return self.encode_ids(ids)[ranks]

    def encode_ids(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return [k] the class of each of distinct ``ids`` [k]; as :meth:`encode`."""
        classes = [self._class_of(raw) for raw in ids.tolist()]
        return self.merged(np.array(classes, np.int32))

    def decode(self, classes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the ids of ``classes`` (any shape); ignored or unknown ones become 0."""
        known = (classes >= 0) & (classes < self.count)
        return np.where(known, self.ids[np.where(known, classes, 0)], NO_OBJECT).astype(np.int32)

    def merged(self, classes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return ``classes`` (any shape), each as the class that stands for its object."""
        merged_into = np.array([*self._merged_into, IGNORED], np.int32)
        return merged_into[classes]  # IGNORED is the last

    def new_class(self, *, shares_id_of: int | None = None) -> int:
        """Return a new class, where the table is not :attr:`full`; it goes by "no object" until given an id.

        Args:
            shares_id_of: the class whose mask id stands for the new one's object, too.
        """
        self._ids.append(NO_OBJECT)
        self._merged_into.append(self.count - 1)
        if shares_id_of is not None:
            self._shares_id_of[self.count - 1] = shares_id_of
        return self.count - 1

    def id_owners(self, classes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return ``classes`` (any shape), each as the class that owns the mask id it comes under."""
        table = np.arange(self.count + 1, dtype=np.int32)
        table[-1] = IGNORED
        for index, owner in self._shares_id_of.items():
            table[index] = owner
        return self.merged(table)[classes]

    def same_mask_id(self, one: int, other: int) -> bool:
        """Whether a mask's id stands for the objects of both classes."""
        first, second = self.id_owners(np.array([one, other], np.int32)).tolist()
        return first == second

    def assign_id(self, index: int) -> int:
        """Give class ``index`` the lowest free id if it has none; return its id."""
        if self._ids[index] == NO_OBJECT and index > 0:
            taken = {*self._ids, *self._class_of_id}
            self._ids[index] = next(i for i in range(1, len(taken) + 2) if i not in taken)
        return self._ids[index]

    def merge(self, kept: int, gone: int) -> None:
        """Let class ``gone``, and what was merged into it, stand for the object of class ``kept``.

        Raises:
            ValueError: one of them is "no object".
        """
        kept, old = self._merged_into[kept], self._merged_into[gone]
        if 0 in (kept, old):
            raise ValueError(f'classes {kept} and {gone}: "no object" is not merged with an object')
        if self._ids[kept] == NO_OBJECT:
            self._ids[kept] = self._ids[old]
        self._merged_into = [kept if into == old else into for into in self._merged_into]

    def sources(self) -> dict[int, tuple[int, ...]]:
        """Return id -> the mask ids that became it, where they are not itself alone."""
        found: dict[int, list[int]] = {}
        ids = self.ids.tolist()
        for raw, index in self._class_of_id.items():
            merged = self._merged_into
            sharing = [i for i, owner in self._shares_id_of.items() if merged[owner] == merged[index]]
            for identifier in {ids[i] for i in (index, *sharing)}:
                found.setdefault(identifier, []).append(raw)
        return {i: tuple(sorted(raws)) for i, raws in sorted(found.items()) if raws != [i]}

    def _class_of(self, raw: int) -> int:
        if raw not in self._class_of_id:
            if raw < 0 or self.full:
                return IGNORED
            others = [index for index, taken in enumerate(self._ids) if taken == raw]
            self._class_of_id[raw] = index = self.new_class()
            if raw in self._ids[: self._earlier]:  # the number of another object
                self.assign_id(index)
                return index
            self._ids[-1] = raw
            for index in others:  # had it before it was known to be a mask's
                self._ids[index] = NO_OBJECT
                self.assign_id(index)
        return self._class_of_id[raw]

    def _warn_full(self) -> None:
        if not self._warned:
            log.warning(
                "the masks have named %d objects; further ones are left aside. Do tracked ids mean the same "
                "object in every frame? If not: --masks-kind untracked",
                self.count - 1,
            )
            self._warned = True
