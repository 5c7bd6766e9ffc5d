# SPDX-License-Identifier: Apache-2.0
"""Which earlier keyframes look like this one: a bag of visual words (J. Sivic and A. Zisserman, ICCV 2003).

The words are learned from the run itself: descriptors drawn from those seen so far, drawn anew whenever there
are four times as many keyframes. Nothing is downloaded, and there is nothing that fits one kind of room.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32, Float64

_FIRST = 8
"""With fewer pictures there are no words yet."""

_GROWTH = 4
"""The words are drawn anew when there are so many times the pictures."""

_WORDS = 1024
"""Words at most."""


class VisualIndex(Stateful):
    """Finds pictures by their descriptors; pictures are numbered in the order in which they came.

    Of a picture it keeps a word for each feature; descriptors are asked for again when words are drawn anew.
    """

    STATE = ("_count", "_words", "_words_of", "_next")

    def __init__(self, descriptors: Callable[[int], NDArray[np.uint8]]) -> None:
        """``descriptors`` returns those of a picture that was added, [n, 128], by its number."""
        self._descriptors = descriptors
        self._count = 0
        self._words: Float32 = np.zeros((0, 128), np.float32)
        self._words_of: list[NDArray[np.uint16]] = []  # by picture, once there are words
        self._next = _FIRST

    def __len__(self) -> int:
        return self._count

    def add(self) -> None:
        """Take in the next picture, whose descriptors can be asked for."""
        self._count += 1
        if len(self) >= self._next:
            self._learn_words()
        elif len(self._words):
            self._words_of.append(self._nearest_words(self._descriptors(len(self) - 1)))

    def similarities(self) -> Float64:
        """Return [n - 1] how alike each earlier picture is to the last: cosine of tf-idf; 0 without words."""
        if len(self._words_of) < 2:
            return np.zeros(max(len(self) - 1, 0))
        return self._similarities(self._words_of)

    def similarities_to(self, descriptors: NDArray[np.uint8]) -> Float64:
        """Return [n] how alike each picture is to another one with ``descriptors`` [m, 128]."""
        if not self._words_of:
            return np.zeros(len(self))
        return self._similarities([*self._words_of, self._nearest_words(descriptors)])

    def _similarities(self, words_of: list[NDArray[np.uint16]]) -> Float64:
        """Return [n - 1] how alike each of the pictures but the last, by their features' words, is to it."""
        features = np.array([len(words) for words in words_of])
        pictures, words = np.repeat(np.arange(len(features)), features), np.concatenate(words_of)
        size = len(features), len(self._words)
        counts = sparse.csr_array((1.0 / features[pictures], (pictures, words)), shape=size)
        seen_by = np.bincount(counts.indices, minlength=size[1])
        vectors = counts * np.log(size[0] / np.maximum(seen_by, 1))[None]
        vectors = sparse.csr_array(vectors)
        norms = np.maximum(sparse.linalg.norm(vectors, axis=1), 1e-12)
        return (vectors[:-1] @ vectors[[-1]].toarray()[0]) / (norms[:-1] * norms[-1])

    def _learn_words(self) -> None:
        self._next = _GROWTH * len(self)
        ends = np.cumsum([len(self._descriptors(k)) for k in range(len(self))])
        drawn = np.sort(np.random.default_rng((17, len(self))).permutation(ends[-1])[:_WORDS])
        pictures = np.searchsorted(ends, drawn, side="right")
        words = [self._descriptors(k)[drawn[pictures == k] - ends[k]] for k in np.unique(pictures).tolist()]
        self._words = np.concatenate([np.zeros((0, 128), np.float32), *words]).astype(np.float32)
        self._words_of = [self._nearest_words(self._descriptors(k)) for k in range(len(self))]

    def _nearest_words(self, descriptors: NDArray[np.uint8]) -> NDArray[np.uint16]:
        """Return [n] the word of each of a picture's features."""
        if not len(descriptors) or not len(self._words):
            return np.zeros(0, np.uint16)
        rows = descriptors.astype(np.float32)
        nearest = ((self._words**2).sum(axis=1)[None] - 2.0 * (rows @ self._words.T)).argmin(axis=1)
        return nearest.astype(np.uint16)
