# SPDX-License-Identifier: Apache-2.0
"""The map on the device: a structure of arrays of Gaussians that grows and is pruned.

The map has one writer, the mapper. Arrays live on one Warp device and keep spare capacity;
the first ``count`` rows of each are in use. The other rows are zeros, and a Gaussian whose quaternion is zero
is not rendered: recorded work covers all rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import sim3
from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.adam import AdamState, GaussianArrays
from ggwarp.kernels.optim.rigid_motion import move_gaussians
from ggwarp.map.compaction import gathered, kept_indices
from ggwarp.map.gaussians import Gaussians
from ggwarp.runtime.state import FrameSource, State, Stateful, into_array
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float64

PARAMETERS: dict[str, Any] = {
    "means": wp.vec3,
    "quats": wp.vec4,
    "log_scales": wp.vec3,
    "opacity_logits": wp.float32,
    "colours": wp.vec3,
    "identities": vec16,
}
"""What is optimised: field name -> row type."""

GROWTH = 1.5
"""Arrays that are full become so many times as long."""


class GaussianMap(Stateful):
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

    def state(self) -> State:
        """Return the rows in use of every field."""
        rows = {name: to_host(array)[: self.count].copy() for name, array in self.fields.items()}
        return {"capacity": self.capacity, "count": self.count, "version": self.version, "rows": rows}

    def restore(self, state: State, frames: FrameSource) -> None:
        """Take over the rows; all fields are new arrays."""
        self.count, self.version = state["count"], state["version"]
        for name, old in self.fields.items():
            new = wp.zeros(state["capacity"], dtype=old.dtype, device=self.device)
            if self.count:
                into_array(new[: self.count], state["rows"][name])
            self.fields[name] = new
        self.allocation += 1

    @property
    def capacity(self) -> int:
        return self.fields["means"].shape[0]

    @property
    def row_bytes(self) -> int:
        """Bytes of one Gaussian."""
        return sum(wp.types.type_size_in_bytes(array.dtype) for array in self.fields.values())

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

    def append(self, gaussians: Gaussians) -> None:
        """Add ``gaussians`` at the end, growing the arrays where they are full."""
        if self.has_identity and gaussians.identities is None and len(gaussians):
            raise ValueError("the map has identities, but these Gaussians have none")
        begin = self.extend(len(gaussians))
        for name, array in self.fields.items():
            values = getattr(gaussians, name, None)
            if values is not None and len(gaussians):
                # wp.array keeps no reference to a temporary: copy synchronises on the host side.
                rows: Any = array[begin : self.count]
                wp.copy(rows, wp.array(values, dtype=array.dtype, device=self.device))

    def extend(self, number: int) -> int:
        """Add ``number`` rows of zeros at the end, for the caller to fill; return the first of them."""
        begin, end = self.count, self.count + number
        if number == 0:
            return begin
        self._provide(end)
        for array in self.fields.values():
            rows: Any = array[begin:end]
            rows.zero_()
        self.count = end
        self.version += 1
        return begin

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

    def take_out(self, chosen: NDArray[np.bool_]) -> dict[str, wp.array]:
        """Drop the Gaussians that are ``chosen`` [count], and return all their rows, in stable order."""
        flags = wp.array(chosen.astype(np.int32), dtype=int, device=self.device)
        taken, indices = kept_indices(flags, self.count)
        rows = {name: gathered(array, indices, taken, room=taken) for name, array in self.fields.items()}
        self.keep(wp.array((~chosen).astype(np.int32), dtype=int, device=self.device))
        return rows

    def put_back(self, rows: dict[str, wp.array]) -> None:
        """Add ``rows`` of all fields, which :meth:`take_out` returned, at the end."""
        begin, end = self.count, self.count + rows["means"].shape[0]
        self._provide(end)
        for name, array in self.fields.items():
            into: Any = array[begin:end]
            wp.copy(into, rows[name])
        self.count = end
        self.version += 1

    def move(self, motions: Float64, *, begin: int = 0) -> None:
        """Move each Gaussian by that of ``motions`` [k, 4, 4] of its keyframe, with Adam's memory of it.

        Args:
            motions: rigid, or similarities, see :mod:`ggwarp.geometry.sim3`.
            begin: Gaussians before this one stay.
        """
        if self.count <= begin:
            return
        names = ("keyframe_ids", "means", "quats", "log_scales", "first", "second")
        rigid, scales = zip(*(sim3.split(motion) for motion in motions), strict=True)
        rows: dict[str, Any] = {name: self.fields[name] for name in names}
        move_gaussians(
            wp.array(np.stack(rigid).astype(np.float32), dtype=wp.mat44, device=self.device),
            wp.array(np.array(scales, np.float32), dtype=float, device=self.device),
            count=self.count - begin,
            **{name: array[begin : self.count] for name, array in rows.items()},
            device=self.device,
        )

    def to_host(self) -> Gaussians:
        """Return copies of the rows in use: the parameters, ``keyframe_ids`` and ``votes``."""
        names = [n for n in (*PARAMETERS, "keyframe_ids", "votes") if n in self.fields]
        return Gaussians(**{n: to_host(self.fields[n])[: self.count].copy() for n in names})

    def _provide(self, count: int) -> None:
        """Make room for so many Gaussians."""
        if count > self.capacity:
            self._reallocate(max(count, int(self.capacity * GROWTH)))

    def _reallocate(self, capacity: int) -> None:
        for name, old in self.fields.items():
            new = wp.zeros(capacity, dtype=old.dtype, device=self.device)
            wp.copy(new, old, count=self.count)
            self.fields[name] = new
        self.allocation += 1
