# SPDX-License-Identifier: Apache-2.0
"""Fusing depth images against the same in NumPy, voxel by voxel."""

from __future__ import annotations

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.fusion.tsdf import TsdfGrid, integrate

CAMERA = Camera(20, 16, 18.0, 17.0, 9.2, 7.9)
SHAPE, ORIGIN, VOXEL, TRUNCATION = (14, 13, 12), np.array([-0.6, -0.5, 0.4]), 0.09, 0.25


def reference(depths, rgbs, poses):
    """The mean over images at each voxel, in float64."""
    centres = ORIGIN + VOXEL * np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1)
    sums, weights, colours, coloured = (
        np.zeros(SHAPE),
        np.zeros(SHAPE),
        np.zeros((*SHAPE, 3)),
        np.zeros(SHAPE),
    )
    for depth, rgb, T_wc in zip(depths, rgbs, poses, strict=True):
        local = se3.transform_points(se3.inverse(T_wc), centres.reshape(-1, 3)).reshape(*SHAPE, 3)
        rows, columns, inside = CAMERA.pixels_of(local)
        d = depth[rows, columns].astype(np.float64)
        distance = d - local[..., 2]
        counts = inside & (d > 0.0) & (distance >= -TRUNCATION)
        sums += counts * np.minimum(distance / TRUNCATION, 1.0)
        weights += counts
        near = counts & (distance < TRUNCATION)
        colours += near[..., None] * rgb[rows, columns]
        coloured += near
    return (
        sums / np.maximum(weights, 1), weights, colours / np.maximum(coloured, 1)[..., None], coloured,
    )  # fmt: skip


def test_every_voxel_has_the_mean_of_its_images(device, rng):
    depths = rng.uniform(0.5, 1.6, (4, 16, 20)).astype(np.float32)
    depths[rng.random(depths.shape) < 0.2] = 0.0
    rgbs = rng.uniform(0.0, 1.0, (4, 16, 20, 3)).astype(np.float32)
    poses = [se3.se3_exp(rng.normal(0.0, 0.2, 6)) for _ in range(4)]
    grid = TsdfGrid()
    for name, kind in (
        ("distances", float),
        ("weights", float),
        ("colours", wp.vec3),
        ("colour_weights", float),
    ):
        setattr(grid, name, wp.zeros(SHAPE, dtype=kind, device=device))
    grid.origin, grid.voxel, grid.truncation = wp.vec3(*ORIGIN), VOXEL, TRUNCATION
    for depth, rgb, T_wc in zip(depths, rgbs, poses, strict=True):
        # In two parts, as views that reach a part of the volume do.
        for low, size in (((0, 0, 0), (14, 13, 5)), ((0, 0, 5), (14, 13, 7))):
            integrate(
                wp.array(depth, dtype=float, device=device),
                wp.array(rgb, dtype=wp.vec3, device=device),
                T_cw=wp.mat44(se3.inverse(T_wc).astype(np.float32)),
                camera=intrinsics_of(CAMERA),
                low=low,
                size=size,
                grid=grid,
                device=device,
            )
    expected = reference(depths, rgbs, poses)
    found = [getattr(grid, n).numpy() for n in ("distances", "weights", "colours", "colour_weights")]
    # Rounding may put a voxel's centre into the next pixel, or across a truncation.
    same = (found[1] == expected[1]) & (found[3] == expected[3])
    assert same.mean() > 0.99 and expected[1].max() == 4.0
    assert np.abs(found[0] - expected[0])[same].max() < 1e-4
    assert np.abs(found[2] - expected[2])[same].max() < 1e-4
