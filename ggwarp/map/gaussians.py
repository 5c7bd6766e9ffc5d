# SPDX-License-Identifier: Apache-2.0
"""Gaussians on the host: what enters a map, what leaves it, and what is edited and stored."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float32

if TYPE_CHECKING:
    from ggwarp.geometry.boxes import Extents

SH_C0 = 0.28209479177387814
"""Degree-0 spherical harmonic: colour = 0.5 + C0 f."""


@dataclass(frozen=True)
class Gaussians:
    """Gaussians as NumPy arrays (world frame, metres).

    Attributes:
        means: [n, 3] float32 positions.
        quats: [n, 4] float32 rotations, w first; not necessarily unit.
        log_scales: [n, 3] float32 logarithms of the standard deviations.
        opacity_logits: [n] float32.
        colours: [n, 3] float32 spherical-harmonics coefficients of degree 0.
        object_ids: [n] int32, 0 = none; None: not known.
        identities: [n, 16] float32; None without identities.
        keyframe_ids: [n] int32 number of the keyframe that brought each; None: 0, or not known.
        votes: [n] int32 labels seen so far (:mod:`ggwarp.kernels.identity.label_fusion`); None: none, or not
            known.
    """

    means: Float32
    quats: Float32
    log_scales: Float32
    opacity_logits: Float32
    colours: Float32
    object_ids: NDArray[np.int32] | None = None
    identities: Float32 | None = None
    keyframe_ids: NDArray[np.int32] | None = None
    votes: NDArray[np.int32] | None = None

    def __len__(self) -> int:
        return len(self.means)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that are there, by name."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: array for name, array in values.items() if array is not None}

    def extents(self) -> Extents:
        """Return how far they reach."""
        from ggwarp.geometry.boxes import Extents  # brings OpenCV, which files need not

        return Extents.of(self.quats, self.log_scales, self.opacity_logits)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.integer[Any]]) -> Gaussians:
        """Return the Gaussians of ``rows``: [n] bool which of them, or [k] row numbers, which may repeat."""
        return Gaussians(**{name: array[rows] for name, array in self.arrays().items()})


def identities(parts: Iterable[Gaussians]) -> Float32 | None:
    """Return [n, 16] those of a map's ``parts``; None where it has none."""
    known = [part.identities for part in parts if part.identities is not None]
    return np.concatenate(known) if known else None


def join(first: Gaussians, *others: Gaussians) -> Gaussians:
    """Return the Gaussians of all, in this order.

    Raises:
        ValueError: one has an array, such as object ids or identities, that another has not.
    """
    parts = [gaussians.arrays() for gaussians in (first, *others)]
    for field in fields(Gaussians):
        having = [field.name in part for part in parts]
        if any(having) and not all(having):
            raise ValueError(f"only some of the maps have {field.name}")
    return Gaussians(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
