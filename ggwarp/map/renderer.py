# SPDX-License-Identifier: Apache-2.0
"""Renders the map and takes an image's gradient back to it, in arrays that are kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.math import vec6
from ggwarp.kernels.optim.adam import GaussianArrays
from ggwarp.kernels.raster.composite import composite, composite_adjoint
from ggwarp.kernels.raster.project import Window, project
from ggwarp.kernels.raster.project_adjoint import pose_levels, project_adjoint
from ggwarp.kernels.raster.sampling import Sample
from ggwarp.kernels.raster.thinning import thin_planes
from ggwarp.kernels.raster.tiles import TILE, TileCapacityError, bin_splats
from ggwarp.kernels.raster.tiles_parallel import PEAK
from ggwarp.kernels.workspaces import allocate_slot_gradients, allocate_splats, allocate_tiles
from ggwarp.map.gaussian_map import PARAMETERS, GaussianMap
from ggwarp.runtime.state import FrameSource, State, Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32, Float64, Rendered

_SLOTS_PER_GAUSSIAN = 4
_GROWTH = 1.5


def padded(size: int) -> int:
    """Return ``size`` rounded up to whole tiles."""
    return -(-size // int(TILE)) * int(TILE)


@dataclass(frozen=True)
class Planes:
    """A render, or every n-th pixel of one, on the device, padded to whole tiles.

    Attributes:
        image: [C, Hp, Wp] float: colour, depth, identity.
        transmittance, median_depth: [Hp, Wp] float.
    """

    image: Any
    transmittance: Any
    median_depth: Any


class Renderer(Stateful):
    """Renders one map for one camera.

    Attributes:
        image: [C, Hp, Wp] float: colour, depth, identity; of the last :meth:`forward` or :meth:`render`.
        transmittance, median_depth: [Hp, Wp] float.
        d_image, d_transmittance: gradients for :meth:`adjoint`; zeros at first.
        gradients: of the visible Gaussians' parameters, after :meth:`adjoint`.
        weights: [capacity] float, of the visible Gaussians: how many pixels, padding included, each makes up,
            after :meth:`adjoint`.
        d_pose: [1] vec6, gradient (translation, rotation) of T_cw <- Exp(tau) T_cw, after :meth:`adjoint`
            with ``pose`` or :meth:`adjoint_pose`.
        splats: the projection of the last :meth:`forward`.
        tiles: the binning.
        allocation: grows whenever arrays are allocated anew.
    """

    def __init__(
        self, gaussians: GaussianMap, camera: Camera, *, identity: bool = True, identity_shapes: bool = True
    ) -> None:
        """Allocate for ``camera``.

        Args:
            identity: render identities, if the map has them; tracking can do without.
            identity_shapes: let the identity's gradient also shape the Gaussians, as in Gaussian Grouping;
                without, it reaches identities alone.
        """
        self._identity_shapes = identity_shapes
        self._map = gaussians
        self.camera = camera
        self._intrinsics = intrinsics_of(camera)
        self._device = gaussians.device
        self._channels = 20 if gaussians.has_identity and identity else 4
        shape = (padded(camera.height), padded(camera.width))

        def zeros(*size: int) -> wp.array:
            return wp.zeros(size, dtype=float, device=self._device)

        self.image, self.d_image = zeros(self._channels, *shape), zeros(self._channels, *shape)
        self.transmittance, self.d_transmittance = zeros(*shape), zeros(*shape)
        self.median_depth = zeros(*shape)
        row: Any = vec6
        self.d_pose = wp.zeros(1, dtype=row, device=self._device)
        self._sample: Sample | None = None
        self._pose: tuple[wp.array, ...] = ()
        self._thinned: dict[tuple[int, int], Planes] = {}
        self._capacity = 0
        self.allocation = 0
        self._reserve()

    def state(self) -> State:
        """Return the room for tile slots: on CUDA a view that lacks some leaves splats out."""
        return {"slots": self.tiles.capacity}

    def restore(self, state: State, frames: FrameSource) -> None:
        """Make the same room; the map has its own already."""
        self._reserve()
        if state["slots"] > self.tiles.capacity:
            self._allocate_tiles(state["slots"])

    @property
    def rows(self) -> int:
        """Rows of the map that are rendered: those in use; in a recording, which outlives growth, all."""
        return self._map.capacity if self._device.is_capturing else self._map.count

    @property
    def ranks(self) -> Any:
        """[rows] int: :attr:`TileArrays.ranks`, -1 for Gaussians that the last view does not show."""
        return self.tiles.ranks[: self.rows]

    def forward(self, T_cw: wp.array, *, sample: Sample | None = None, window: Window | None = None) -> None:
        """Render from ``T_cw`` ([1] mat44, world to camera); identities in ``sample``, or everywhere.

        With a ``window``, of whole tiles, nothing is outside, and inside every bit is as without.

        Nothing is read back on CUDA or in a recording: where tile slots do not suffice the farthest splats
        are left out, until :meth:`make_room`; see also :meth:`render`.
        """
        self._bin(T_cw, window)
        self._sample = sample
        composite(
            self.splats,
            self.tiles,
            width=self.camera.width,
            height=self.camera.height,
            image=self.image,
            transmittance=self.transmittance,
            median_depth=self.median_depth,
            identities=self._identities,
            sample=self._sample,
        )

    def render(self, T_wc: Float64, *, window: Window | None = None) -> None:
        """Render all that is seen from ``T_wc`` [4, 4], or in a ``window``; wait for the device."""
        T_cw = self.pose_array(T_wc)
        self.forward(T_cw, window=window)
        if self.make_room():
            self.forward(T_cw, window=window)

    def adjoint(self, T_cw: wp.array, *, pose: bool = False, mean2d_gradient_norms: bool = False) -> None:
        """Chain ``d_image`` and ``d_transmittance`` to ``gradients``; after :meth:`forward`.

        Args:
            pose: write ``d_pose``, too.
            mean2d_gradient_norms: add to the map's ``mean2d_gradient_norms`` and ``mean2d_gradient_counts``.
        """
        g = self.gradients
        outputs = {f"d_{name}": getattr(g, name) for name in PARAMETERS} | {"weights": self.weights}
        fields = self._map.fields
        counted = (
            (fields["mean2d_gradient_norms"], fields["mean2d_gradient_counts"])
            if mean2d_gradient_norms
            else None
        )
        self._chain(T_cw, outputs, self._pose_scratch() if pose else (), counted)

    def adjoint_pose(self, T_cw: wp.array) -> None:
        """Chain ``d_image`` and ``d_transmittance`` to ``d_pose`` alone; after :meth:`forward`."""
        self._chain(T_cw, {}, self._pose_scratch())

    def _chain(
        self,
        T_cw: wp.array,
        outputs: dict[str, wp.array],
        pose: tuple[wp.array, ...],
        mean2d_gradient_norms: tuple[wp.array, wp.array] | None = None,
    ) -> None:
        m = self._map.parameters
        composite_adjoint(
            self.splats,
            self.tiles,
            image=self.image,
            transmittance=self.transmittance,
            d_image=self.d_image,
            d_transmittance=self.d_transmittance,
            out=self._slots,
            identities=self._identities,
            sample=self._sample,
            identity_shapes=self._identity_shapes,
        )
        project_adjoint(
            m.means, m.quats, m.log_scales, m.opacity_logits, m.colours,
            T_cw=T_cw, camera=self._intrinsics, count=self.rows,
            tiles=self.tiles, slots=self._slots,
            mean2d_gradient_norms=mean2d_gradient_norms, d_pose_scratch=pose, **outputs,
        )  # fmt: skip

    @property
    def _identities(self) -> wp.array | None:
        """Those that are rendered."""
        return self._map.parameters.identities if self._channels == 20 else None

    def _pose_scratch(self) -> tuple[wp.array, ...]:
        lengths = pose_levels(self._capacity)
        if not self._pose or self._pose[0].shape[0] != lengths[0]:
            row: Any = vec6
            inner = (wp.empty(k, dtype=row, device=self._device) for k in lengths[:-1])
            self._pose = (*inner, self.d_pose)
        return self._pose

    def pose_array(self, T_wc: Float64) -> wp.array:
        """Return ``T_wc`` [4, 4] as the kernels want it: world to camera, on the device."""
        matrix = se3.inverse(T_wc).astype(np.float32)
        return wp.array(matrix[None], dtype=wp.mat44, device=self._device)

    def plane(self, array: Any) -> Float32:
        """Return a copy of a plane or image, without its padding."""
        return to_host(array)[..., : self.camera.height, : self.camera.width].copy()

    def picture(self, step: int = 1) -> Rendered:
        """Return the last render on the host, every ``step``-th pixel of it, without identities."""
        few = self.thinned(step, channels=4)
        h, w = (len(range(step // 2, size, step)) for size in (self.camera.height, self.camera.width))
        image, transmittance, median_depth = (to_host(plane)[..., :h, :w] for plane in vars(few).values())
        return Rendered(
            rgb=np.ascontiguousarray(np.clip(image[:3], 0.0, 1.0).transpose(1, 2, 0)),
            depth=image[3].copy(),
            median_depth=median_depth.copy(),
            opacity=np.float32(1.0) - transmittance,
        )

    @property
    def planes(self) -> Planes:
        """The last render."""
        return Planes(self.image, self.transmittance, self.median_depth)

    def thinned(self, step: int, *, channels: int | None = None) -> Planes:
        """Return every ``step``-th pixel of the last render, on the device, until the next call.

        Args:
            channels: so many of the image's; None: all.
        """
        whole = Planes(self.image[:channels], self.transmittance, self.median_depth)
        if step == 1:
            return whole
        key = step, whole.image.shape[0]
        if key not in self._thinned:
            shape = tuple(padded(len(range(step // 2, size, step))) for size in self.transmittance.shape)
            self._thinned[key] = Planes(
                *(
                    wp.empty((*a.shape[:-2], *shape), dtype=float, device=self._device)
                    for a in vars(whole).values()
                )
            )
        few = self._thinned[key]
        for source, out in zip(vars(whole).values(), vars(few).values(), strict=True):
            thin_planes(_stacked(source), step=step, out=_stacked(out), device=self._device)
        return few

    def identity(self) -> Float32:
        """Return the identities [h, w, 16] of the last render on the host: far more than its picture."""
        return np.ascontiguousarray(self.plane(self.image[4:]).transpose(1, 2, 0))

    def make_room(self) -> bool:
        """Allocate the tile slots that renders so far lacked; wait for the device. True if they did."""
        peak = int(to_host(self.tiles.counts)[PEAK])
        if peak <= self.tiles.capacity:
            return False
        self._allocate_tiles(int(peak * _GROWTH))
        return True

    def provide(self, T_cw: wp.array, *, window: Window | None = None) -> None:
        """Make room for a view's tile slots, or those of a ``window`` of it, beforehand."""
        self._bin(T_cw, window)
        self.make_room()

    def _bin(self, T_cw: wp.array, window: Window | None = None) -> None:
        self._reserve()
        m = self._map.parameters
        project(
            m.means, m.quats, m.log_scales, m.opacity_logits, m.colours,
            self._identities,
            T_cw=T_cw, camera=self._intrinsics, count=self.rows, out=self.splats, window=window,
        )  # fmt: skip
        while True:
            try:
                bin_splats(
                    self.splats.tile_rects,
                    self.splats.depths,
                    count=self.rows,
                    width=self.camera.width,
                    height=self.camera.height,
                    out=self.tiles,
                )
                return
            except TileCapacityError as error:
                self._allocate_tiles(int(error.needed * _GROWTH))

    def _reserve(self) -> None:
        """Make room for the map's capacity."""
        capacity = self._map.capacity
        if capacity == self._capacity:
            return
        self._capacity = capacity
        self.splats = allocate_splats(capacity, device=self._device)
        self.gradients = GaussianArrays(
            *(
                wp.zeros(capacity, dtype=self._map.fields[n].dtype, device=self._device)
                if n in self._map.fields and (n != "identities" or self._channels == 20)
                else None
                for n in PARAMETERS
            )
        )
        self.weights = wp.zeros(capacity, dtype=float, device=self._device)
        self._allocate_tiles(_SLOTS_PER_GAUSSIAN * capacity)

    def _allocate_tiles(self, slots: int) -> None:
        self.tiles = allocate_tiles(
            self._capacity, slots, width=self.camera.width, height=self.camera.height, device=self._device
        )
        self._slots: Any = allocate_slot_gradients(slots, self._channels, device=self._device)
        self.allocation += 1


def _stacked(planes: Any) -> Any:
    """Return one plane [H, W] as [1, H, W], and several as they are."""
    return planes if planes.ndim == 3 else planes.reshape((1, *planes.shape))
