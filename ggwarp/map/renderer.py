# SPDX-License-Identifier: Apache-2.0
"""Renders the map and takes an image's gradient back to it, in arrays that are kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ggwarp import lie
from ggwarp.kernels.adam import GaussianArrays
from ggwarp.kernels.composite import composite, composite_adjoint
from ggwarp.kernels.project import intrinsics_of, project
from ggwarp.kernels.project_adjoint import project_adjoint
from ggwarp.kernels.tiles import TILE, TileCapacityError, bin_splats
from ggwarp.map.gaussians import PARAMETERS, GaussianMap
from ggwarp.ops.workspace import allocate_slot_gradients, allocate_splats, allocate_tiles
from ggwarp.types import Camera, Float32, Float64

_SLOTS_PER_GAUSSIAN = 4
_GROWTH = 1.5


def padded(size: int) -> int:
    """Return ``size`` rounded up to whole tiles."""
    return -(-size // int(TILE)) * int(TILE)


class Renderer:
    """Renders one map for one camera.

    Attributes:
        image: [C, Hp, Wp] float: colour, depth, identity; of the last :meth:`forward`.
        transmittance, median_depth: [Hp, Wp] float.
        d_image, d_transmittance: gradients for :meth:`adjoint`; zeros at first.
        gradients: of the visible Gaussians' parameters, after :meth:`adjoint`.
        tiles: the binning; ``tiles.ranks`` is -1 for Gaussians the view does not show.
    """

    def __init__(self, gaussians: GaussianMap, camera: Camera) -> None:
        self._map = gaussians
        self.camera = camera
        self._intrinsics = intrinsics_of(camera)
        self._device = gaussians.device
        self._channels = 20 if gaussians.has_identity else 4
        shape = (padded(camera.height), padded(camera.width))

        def zeros(*size: int) -> wp.array:
            return wp.zeros(size, dtype=float, device=self._device)

        self.image, self.d_image = zeros(self._channels, *shape), zeros(self._channels, *shape)
        self.transmittance, self.d_transmittance = zeros(*shape), zeros(*shape)
        self.median_depth = zeros(*shape)
        self._capacity = 0
        self._reserve()

    def forward(self, T_cw: wp.array) -> None:
        """Render from ``T_cw`` ([1] mat44, world to camera)."""
        self._reserve()
        m = self._map.parameters
        project(
            m.means, m.quats, m.log_scales, m.opacity_logits, m.colours, m.identities,
            T_cw=T_cw, camera=self._intrinsics, count=self._map.count, out=self._splats,
        )  # fmt: skip
        self._bin()
        composite(
            self._splats,
            self.tiles,
            width=self.camera.width,
            height=self.camera.height,
            image=self.image,
            transmittance=self.transmittance,
            median_depth=self.median_depth,
        )

    def adjoint(self, T_cw: wp.array) -> None:
        """Chain ``d_image`` and ``d_transmittance`` to ``gradients``; after :meth:`forward`."""
        m, g = self._map.parameters, self.gradients
        composite_adjoint(
            self._splats,
            self.tiles,
            image=self.image,
            transmittance=self.transmittance,
            d_image=self.d_image,
            d_transmittance=self.d_transmittance,
            out=self._slots,
        )
        project_adjoint(
            m.means, m.quats, m.log_scales, m.opacity_logits, m.colours,
            T_cw=T_cw, camera=self._intrinsics, count=self._map.count,
            tiles=self.tiles, slots=self._slots,
            d_means=g.means, d_quats=g.quats, d_log_scales=g.log_scales,
            d_opacity_logits=g.opacity_logits, d_colours=g.colours, d_identities=g.identities,
        )  # fmt: skip

    def pose_array(self, T_wc: Float64) -> wp.array:
        """Return ``T_wc`` [4, 4] as the kernels want it: world to camera, on the device."""
        matrix = lie.inverse(T_wc).astype(np.float32)
        return wp.array(matrix[None], dtype=wp.mat44, device=self._device)

    def plane(self, array: wp.array) -> Float32:
        """Return a copy of a plane or image, without its padding."""
        return array.numpy()[..., : self.camera.height, : self.camera.width].copy()

    def _bin(self) -> None:
        while True:
            try:
                bin_splats(
                    self._splats.tile_rects,
                    self._splats.depths,
                    count=self._map.count,
                    width=self.camera.width,
                    height=self.camera.height,
                    out=self.tiles,
                )
                return
            except TileCapacityError as error:
                self._allocate_tiles(int(error.needed * _GROWTH))

    def _reserve(self) -> None:
        """Make room for the map's capacity and, on CUDA, for the pairs of the last render."""
        capacity = self._map.capacity
        if capacity == self._capacity:
            if not self._device.is_cpu:
                # The device leaves out the farthest splats and says so; read one render late.
                _, pairs, overflow = self.tiles.counts.numpy().tolist()
                if overflow:
                    self._allocate_tiles(int(pairs * _GROWTH))
            return
        self._capacity = capacity
        self._splats = allocate_splats(capacity, self._channels, device=self._device)
        self.gradients = GaussianArrays(
            *(
                wp.zeros(capacity, dtype=self._map.fields[n].dtype, device=self._device)
                if n in self._map.fields
                else None
                for n in PARAMETERS
            )
        )
        self._allocate_tiles(_SLOTS_PER_GAUSSIAN * capacity)

    def _allocate_tiles(self, slots: int) -> None:
        self.tiles = allocate_tiles(
            self._capacity, slots, width=self.camera.width, height=self.camera.height, device=self._device
        )
        self._slots: Any = allocate_slot_gradients(slots, self._channels, device=self._device)
