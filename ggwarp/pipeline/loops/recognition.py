# SPDX-License-Identifier: Apache-2.0
"""Which earlier keyframes look like this one: a bag of visual words (J. Sivic and A. Zisserman, ICCV 2003).

The words are learned from the run itself: descriptors drawn from those seen so far, drawn anew whenever there
are four times as many keyframes. Nothing is downloaded, and there is nothing that fits one kind of room.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32, Float64

_FIRST = 8
"""With fewer pictures there are no words yet."""

_GROWTH = 4
"""The words are drawn anew when there are so many times the pictures."""

_WORDS = 1024
"""Words at most."""


class VisualIndex(Stateful):
    """Finds pictures by their descriptors; pictures are numbered in the order in which they came."""

    STATE = ("_descriptors", "_words", "_counts", "_next")

    def __init__(self) -> None:
        self._descriptors: list[NDArray[np.uint8]] = []
        self._words: Float32 = np.zeros((0, 128), np.float32)
        self._counts: list[Float64] = []
        self._next = _FIRST

    def __len__(self) -> int:
        return len(self._descriptors)

    def add(self, descriptors: NDArray[np.uint8]) -> None:
        """Take in the next picture's ``descriptors`` [n, 128]."""
        self._descriptors.append(descriptors)
        if len(self) >= self._next:
            self._learn_words()
        elif len(self._words):
            self._counts.append(self._count(descriptors))

    def similarities(self) -> Float64:
        """Return [n - 1] how alike each earlier picture is to the last: cosine of tf-idf; 0 without words."""
        if len(self._counts) < 2:
            return np.zeros(max(len(self) - 1, 0))
        return self._similarities(np.stack(self._counts))

    def similarities_to(self, descriptors: NDArray[np.uint8]) -> Float64:
        """Return [n] how alike each picture is to another one with ``descriptors`` [m, 128]."""
        if not self._counts:
            return np.zeros(len(self))
        return self._similarities(np.stack([*self._counts, self._count(descriptors)]))

    def _similarities(self, counts: Float64) -> Float64:
        """Return [n - 1] how alike each of the pictures but the last, by ``counts`` [n, words], is to it."""
        seen_by = (counts > 0.0).sum(axis=0)
        weights = np.log(len(counts) / np.maximum(seen_by, 1))
        vectors = counts * weights
        vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
        return vectors[:-1] @ vectors[-1]

    def _learn_words(self) -> None:
        self._next = _GROWTH * len(self)
        rows = np.concatenate(self._descriptors)
        drawn = np.random.default_rng((17, len(self))).permutation(len(rows))[:_WORDS]
        self._words = rows[np.sort(drawn)].astype(np.float32)
        self._counts = [self._count(descriptors) for descriptors in self._descriptors]

    def _count(self, descriptors: NDArray[np.uint8]) -> Float64:
        """Return [words] the share of the picture's features that are each word."""
        if not len(descriptors) or not len(self._words):
            return np.zeros(len(self._words))
        rows = descriptors.astype(np.float32)
        nearest = ((self._words**2).sum(axis=1)[None] - 2.0 * (rows @ self._words.T)).argmin(axis=1)
        return np.bincount(nearest, minlength=len(self._words)) / len(rows)
