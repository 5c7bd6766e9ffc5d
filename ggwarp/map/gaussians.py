# SPDX-License-Identifier: Apache-2.0
"""The map: a structure of arrays of Gaussians that grows and is pruned.

The map has one writer, the mapper. Arrays live on one Warp device and keep spare capacity;
the first ``count`` rows of each are in use. The other rows are zeros, and a Gaussian whose quaternion is zero
is not rendered: recorded work covers all rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.adam import AdamState, GaussianArrays
from ggwarp.map.compaction import gathered, kept_indices
from ggwarp.runtime.streams import to_host

PARAMETERS: dict[str, Any] = {
    "means": wp.vec3,
    "quats": wp.vec4,
    "log_scales": wp.vec3,
    "opacity_logits": wp.float32,
    "colours": wp.vec3,
    "identities": vec16,
}
"""What is optimised: field name -> row type."""

SH_C0 = 0.28209479177387814
"""Degree-0 spherical harmonic: colour = 0.5 + C0 f."""

_GROWTH = 1.5


@dataclass(frozen=True)
class GaussianBatch:
    """Gaussians on the host, about to enter a map (world frame, metres).

    Attributes:
        means: [n, 3] float32.
        quats: [n, 4] float32, w first.
        log_scales: [n, 3] float32, log of standard deviations.
        opacity_logits: [n] float32.
        colours: [n, 3] float32, degree-0 spherical harmonics.
        identities: [n, 16] float32; None where the map has no identities.
        keyframe_ids: [n] int32, number of the keyframe that brought each; None: 0.
        votes: [n] int32, labels seen so far (:mod:`ggwarp.kernels.identity.label_fusion`); None: none.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    colours: NDArray[np.float32]
    identities: NDArray[np.float32] | None = None
    keyframe_ids: NDArray[np.int32] | None = None
    votes: NDArray[np.int32] | None = None

    def __len__(self) -> int:
        return len(self.means)


class GaussianMap:
    """Gaussians and their Adam moments on one device.

    Attributes:
        device: Warp device.
        count: Gaussians in use.
        has_identity: whether ``identities`` is there.
        version: grows whenever rows are added or removed.
        allocation: grows whenever ``fields`` become other arrays.
        fields: name -> array of ``capacity`` rows: the parameters, the optimiser's state,
            ``keyframe_ids``, ``votes``, ``low_weight_counts`` (``optim.compact.count_low_weight``),
            ``mean2d_gradient_norms`` and ``mean2d_gradient_counts`` (``raster.project_adjoint``).
    """

    def __init__(self, *, device: Any, has_identity: bool, capacity: int = 1 << 15) -> None:
        self.device = wp.get_device(device)
        self.has_identity = has_identity
        self.count = 0
        self.version = 0
        self.allocation = 0
        names = [n for n in PARAMETERS if has_identity or n != "identities"]
        types = {n: PARAMETERS[n] for n in names}
        types |= {
            "first": vec16,
            "second": vec16,
            "steps": wp.int32,
            "keyframe_ids": wp.int32,
            "low_weight_counts": wp.int32,
        }
        types |= {"mean2d_gradient_norms": wp.float32, "mean2d_gradient_counts": wp.int32}
        if has_identity:
            types |= {"first_identity": vec16, "second_identity": vec16, "votes": wp.int32}
        self.fields = {n: wp.zeros(capacity, dtype=t, device=self.device) for n, t in types.items()}

    @property
    def capacity(self) -> int:
        return self.fields["means"].shape[0]

    @property
    def parameters(self) -> GaussianArrays:
        """The parameters, ``capacity`` rows each."""
        return GaussianArrays(*(self.fields.get(n) for n in PARAMETERS))

    @property
    def adam_state(self) -> AdamState:
        """The optimiser's moments and step counts, ``capacity`` rows each."""
        get = self.fields.get
        return AdamState(
            get("first"), get("second"), get("steps"), get("first_identity"), get("second_identity")
        )

    def append(self, batch: GaussianBatch) -> None:
        """Add ``batch`` at the end, growing the arrays where they are full."""
        begin, end = self.count, self.count + len(batch)
        if begin == end:
            return
        if end > self.capacity:
            self._reallocate(max(end, int(self.capacity * _GROWTH)))
        for name, array in self.fields.items():
            rows: Any = array[begin:end]
            values = getattr(batch, name, None)
            if values is None and name in PARAMETERS:
                raise ValueError("the map has identities, but the batch has none")
            if values is not None:
                # wp.array keeps no reference to a temporary: copy synchronises on the host side.
                wp.copy(rows, wp.array(values, dtype=array.dtype, device=self.device))
            else:
                rows.zero_()
        self.count = end
        self.version += 1

    def keep(self, flags: wp.array) -> int:
        """Drop the Gaussians whose ``flags`` [count] int32 is 0, in stable order.

        Returns:
            How many were dropped.
        """
        kept, indices = kept_indices(flags, self.count)
        dropped = self.count - kept
        if dropped:
            for name, array in self.fields.items():
                self.fields[name] = gathered(array, indices, kept)
            self.allocation += 1
            self.count = kept
            self.version += 1
        return dropped

    def to_host(self) -> dict[str, NDArray[Any]]:
        """Return copies of the parameters' rows in use, as NumPy arrays."""
        return {n: to_host(self.fields[n])[: self.count].copy() for n in PARAMETERS if n in self.fields}

    def _reallocate(self, capacity: int) -> None:
        for name, old in self.fields.items():
            new = wp.zeros(capacity, dtype=old.dtype, device=self.device)
            wp.copy(new, old, count=self.count)
            self.fields[name] = new
        self.allocation += 1
