# SPDX-License-Identifier: Apache-2.0
"""The trained identity classifier on the host, as a file beside the map: ``classifier.npz``."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ggwarp.io.atomic import atomic_write
from ggwarp.types import Float32


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
        logits = identities @ self.weights.T + self.biases
        logits -= logits.max(axis=1, keepdims=True)
        exponentials = np.exp(logits)
        return exponentials[:, self.ids == object_id].sum(axis=1) / exponentials.sum(axis=1)


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
        OSError: the file cannot be read.
        ValueError: it holds something else.
    """
    try:
        with np.load(path) as arrays:
            found = LinearClassifier(arrays["weights"], arrays["biases"], arrays["ids"])
    except (KeyError, ValueError, zipfile.BadZipFile):
        raise ValueError(f"{path}: is no identity classifier; run the sequence again") from None
    if found.weights.shape != (len(found.ids), 16) or found.biases.shape != found.ids.shape:
        raise ValueError(f"{path}: its arrays do not fit together; run the sequence again")
    return found
