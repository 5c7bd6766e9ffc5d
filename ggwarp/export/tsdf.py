# SPDX-License-Identifier: Apache-2.0
"""Depth images fused into a truncated signed distance (TSDF), and the triangles where it is 0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.camera import NEAR, Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.fusion.tsdf import TsdfGrid, integrate
from ggwarp.results.saved_run import RunError
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32, Float64

Ints = NDArray[np.int32]

_MOST_VOXELS = 16_000_000
_FINEST, _COARSEST = 0.002, 0.5  # metres
_TRUNCATION = 4.0  # voxels
_TRIM = 0.5  # percent of the points beyond the volume on each side


@dataclass(frozen=True)
class Mesh:
    """Triangles with coloured corners.

    Attributes:
        vertices, normals: [n, 3] float32; metres, and unit vectors outwards.
        colours: [n, 3] float32, 0..1.
        faces: [m, 3] int32 rows of ``vertices``, counter-clockwise from outside.
        object_ids: [m] int32 the object of each face, 0: none.
    """

    vertices: Float32
    normals: Float32
    colours: Float32
    faces: Ints
    object_ids: Ints

    def by_object(self) -> Iterator[tuple[int, Mesh]]:
        """Yield each object's id and its part of the mesh."""
        for identifier in np.unique(self.object_ids).tolist():
            yield identifier, self.only(self.object_ids == identifier)

    def only(self, faces: NDArray[np.bool_]) -> Mesh:
        """Return the mesh of ``faces`` [m] alone, without the vertices of others."""
        used, rows = np.unique(self.faces[faces], return_inverse=True)
        return Mesh(
            self.vertices[used],
            self.normals[used],
            self.colours[used],
            rows.reshape(-1, 3).astype(np.int32),
            self.object_ids[faces],
        )


class TsdfVolume:
    """Depth images as the mean signed distance to the surface.

    Attributes:
        voxel, truncation: metres.
    """

    def __init__(self, points: Float32, *, voxel: float | None, device: Any) -> None:
        """Allocate round ``points`` [n, 3], metres, but for the farthest.

        Args:
            voxel: metres; None: as fine as memory allows, and no finer than a centimetre.

        Raises:
            RunError: ``voxel`` is too small for so large a map, or is none.
        """
        low, high = np.percentile(points.astype(np.float64), [_TRIM, 100.0 - _TRIM], axis=0)
        extent = high - low + 0.1
        finest = float(np.cbrt(np.prod(extent) / _MOST_VOXELS))
        self.voxel = max(0.01, finest * 1.2) if voxel is None else voxel
        if not max(_FINEST, finest) <= self.voxel <= _COARSEST:
            raise RunError(
                f"--voxel {self.voxel:g}: for a map of {' x '.join(f'{e:.1f}' for e in extent)} m give "
                f"{max(_FINEST, finest):.3f} to {_COARSEST} m"
            )
        self.truncation = _TRUNCATION * self.voxel
        margin = self.truncation
        origin = low - margin
        x, y, z = (int(n) for n in np.ceil((high - low + 2.0 * margin) / self.voxel) + 1)
        self._device, self._origin, self._shape = device, origin, (x, y, z)

        def zeros(kind: Any) -> wp.array:
            return wp.zeros((x, y, z), dtype=kind, device=device)

        self._grid: Any = TsdfGrid()
        self._grid.distances, self._grid.weights = zeros(float), zeros(float)
        self._grid.colours, self._grid.colour_weights = zeros(wp.vec3), zeros(float)
        self._grid.origin = wp.vec3(*origin.tolist())
        self._grid.voxel, self._grid.truncation = self.voxel, self.truncation

    def add(self, depth: Float32, rgb: Float32, T_wc: Float64, camera: Camera) -> None:
        """Add an image.

        Args:
            depth: [h, w] metres along the optical axis; 0 = none.
            rgb: [h, w, 3], 0..1.
            T_wc: [4, 4] camera-to-world.
            camera: of the image.
        """
        if not depth.any():
            return
        corners = camera.rays([-0.5, camera.width - 0.5] * 2, [-0.5, -0.5] + [camera.height - 0.5] * 2)
        far = float(depth.max()) + self.truncation
        reach = se3.transform_points(T_wc, np.concatenate([NEAR * corners, far * corners]))
        low = np.floor((reach.min(axis=0) - self._origin) / self.voxel).astype(int)
        high = np.ceil((reach.max(axis=0) - self._origin) / self.voxel).astype(int) + 1
        low, high = np.clip(low, 0, self._shape), np.clip(high, 0, self._shape)
        x, y, z = (int(n) for n in low)
        dx, dy, dz = (int(n) for n in high - low)
        integrate(
            wp.array(depth, dtype=float, device=self._device),
            wp.array(np.ascontiguousarray(rgb, np.float32), dtype=wp.vec3, device=self._device),
            T_cw=wp.mat44(se3.inverse(T_wc).astype(np.float32)),
            camera=intrinsics_of(camera),
            low=(x, y, z),
            size=(dx, dy, dz),
            grid=self._grid,
            device=self._device,
        )

    def surface(self) -> Mesh:
        """Return where the distance is 0 and known on all sides; without objects."""
        from scipy.ndimage import binary_erosion  # heavy, and only needed here
        from skimage.measure import marching_cubes

        distances, weights = to_host(self._grid.distances), to_host(self._grid.weights)
        known = weights > 0.0
        if not (known & (distances < 0.0)).any() or not (known & (distances > 0.0)).any():
            nothing = np.zeros((0, 3), np.float32)
            return Mesh(nothing, nothing, nothing, np.zeros((0, 3), np.int32), np.zeros(0, np.int32))
        # A cell counts if all its corners are known; scikit-image asks about one of them.
        inside = binary_erosion(known, np.ones((3, 3, 3), bool))
        at, faces, _, _ = marching_cubes(distances, 0.0, mask=inside, gradient_direction="descent")
        colours = self._colours(at)
        vertices = (self._origin + self.voxel * at).astype(np.float32)
        faces = faces.astype(np.int32)
        return Mesh(vertices, _normals(vertices, faces), colours, faces, np.zeros(len(faces), np.int32))

    def _colours(self, at: Float32) -> Float32:
        """Return the colours [n, 3] of the voxels next to ``at`` [n, 3], in voxels."""
        rows = np.ravel_multi_index(tuple(np.rint(at).astype(int).T), self._shape)
        return np.clip(to_host(self._grid.colours).reshape(-1, 3)[rows], 0.0, 1.0).astype(np.float32)


def _normals(vertices: Float32, faces: Ints) -> Float32:
    """Return the unit normals [n, 3] of ``vertices``: the mean of their faces', by area."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    areas = np.cross(b - a, c - a)
    normals = np.zeros((len(vertices), 3))
    for k in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(faces[:, k], areas[:, axis], len(vertices))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0).astype(np.float32)
