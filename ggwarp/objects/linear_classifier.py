# SPDX-License-Identifier: Apache-2.0
"""The trained identity classifier on the host, as a file beside the map: ``classifier.npz``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ggwarp.io.atomic import atomic_write
from ggwarp.io.guarded import CLASSIFIER, FileError
from ggwarp.io.npz import read_arrays
from ggwarp.io.printable import printable
from ggwarp.types import Float32

_LARGEST = 1e6
"""Of a weight or bias; trained ones are below a hundred."""


@dataclass(frozen=True)
class LinearClassifier:
    """z = W e + b (GG-SLAM eq. 8).

    Attributes:
        weights: [classes, 16] W.
        biases: [classes] b.
        ids: [classes] the object id of each class; 0 = no object.
    """

    weights: Float32
    biases: Float32
    ids: NDArray[np.int64]

    def probabilities(self, identities: Float32, object_id: int) -> Float32:
        """Return [n] the probability that each of ``identities`` [n, 16] belongs to ``object_id``."""
        exponentials = self._exponentials(identities)
        return exponentials[:, self.ids == object_id].sum(axis=1) / exponentials.sum(axis=1)

    def confidence(self, identities: Float32) -> Float32:
        """Return [n] the probability of each of ``identities``' [n, 16] likeliest class."""
        return 1.0 / self._exponentials(identities).sum(axis=1)

    def _exponentials(self, identities: Float32) -> Float32:
        """Return [n, classes] exp(z), the largest of each row 1."""
        logits = identities @ self.weights.T + self.biases
        return np.exp(logits - logits.max(axis=1, keepdims=True))


def write_classifier(path: str | Path, classifier: LinearClassifier) -> None:
    """Write ``classifier``.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_write(path) as file:
        np.savez(file, weights=classifier.weights, biases=classifier.biases, ids=classifier.ids)


def read_classifier(path: str | Path) -> LinearClassifier:
    """Read what :func:`write_classifier` wrote.

    Raises:
        FileError: the file cannot be read, or holds something else.
    """
    try:
        arrays = read_arrays(path, CLASSIFIER, {"weights": "f", "biases": "f", "ids": "iuf"})
    except FileError as error:
        raise FileError(f"{error}; run the sequence again") from None
    weights, biases, ids = arrays["weights"], arrays["biases"], arrays["ids"]
    if ids.ndim != 1 or weights.shape != (len(ids), 16) or biases.shape != ids.shape:
        raise FileError(f"{printable(str(path))}: its arrays do not fit together; run the sequence again")
    if ids.dtype.kind == "f":
        raise FileError(f"{printable(str(path))}: its ids are {ids.dtype}; run the sequence again")
    if not all((np.abs(array) < _LARGEST).all() for array in (weights, biases)):
        raise FileError(f"{printable(str(path))}: holds numbers beyond all bounds; run the sequence again")
    return LinearClassifier(weights, biases, ids)
