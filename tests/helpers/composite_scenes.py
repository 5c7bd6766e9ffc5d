# SPDX-License-Identifier: Apache-2.0
"""Random splats, composited on a device and by the float64 oracle."""

import numpy as np
import torch
import warp as wp

from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.composite import composite, composite_adjoint
from ggwarp.kernels.raster.project import Splats
from ggwarp.kernels.raster.project_adjoint import SlotGradients
from ggwarp.kernels.raster.tiles import bin_splats, tiles_across
from ggwarp.kernels.workspaces import allocate_tiles
from ggwarp.ops.reference.render import composite as composite_reference

NAMES = ("means2d", "conics", "slopes", "features")


def make_scene(rng, n=60, width=40, height=24, channels=20, sigma=(0.6, 5.0), opacity=(0.05, 0.98)):
    """Random splats, float32, as NumPy arrays."""
    angle = rng.uniform(0, np.pi, n)
    c, s = np.cos(angle), np.sin(angle)
    sx, sy = np.exp(rng.uniform(*np.log(sigma), (2, n)))
    xx = (c * sx) ** 2 + (s * sy) ** 2
    yy = (s * sx) ** 2 + (c * sy) ** 2
    xy = c * s * (sx**2 - sy**2)
    det = xx * yy - xy**2
    scene = {
        "means2d": np.stack([rng.uniform(-3, width + 3, n), rng.uniform(-3, height + 3, n)], -1),
        "conics": np.stack([yy / det, -xy / det, xx / det, rng.uniform(*opacity, n)], -1),
        "slopes": rng.normal(size=(n, 2)) * 0.1,
        "depths": rng.permutation(np.linspace(0.5, 4.0, n)),
        "features": rng.uniform(0, 1, (n, channels)),
    }
    return {k: v.astype(np.float32) for k, v in scene.items()}, (width, height)


class Composited:
    """A scene binned and composited on a device."""

    def __init__(self, scene, size, device, *, everywhere=False, cooperative=None, sample=None):
        self.width, self.height = size
        self.device = device
        self.cooperative = cooperative
        self.sample = sample
        n, channels = scene["features"].shape
        rects = np.zeros((n, 4), np.int32)
        columns, rows = tiles_across(self.width), tiles_across(self.height)
        a, b, c, opacity = scene["conics"].astype(np.float64).T
        reach = 2 * np.log(np.maximum(255 * opacity, 1)) / (a * c - b * b)
        for axis, (limit, variance) in enumerate(((columns, c), (rows, a))):
            extent = np.inf if everywhere else np.nan_to_num(np.sqrt(reach * variance), nan=1e3)
            centre = scene["means2d"][:, axis].astype(np.float64)
            rects[:, axis] = np.clip(np.floor((centre - extent) / 16), 0, limit)
            rects[:, axis + 2] = np.clip(np.floor((centre + extent) / 16) + 1, 0, limit)
        rects[(rects[:, 0] >= rects[:, 2]) | (rects[:, 1] >= rects[:, 3])] = 0
        areas = (rects[:, 2] - rects[:, 0]) * (rects[:, 3] - rects[:, 1])
        self.slots = int(areas.sum())
        packed = np.zeros((n, 16), np.float32)
        packed[:, :4], packed[:, 4:6], packed[:, 6:8] = scene["conics"], scene["means2d"], scene["slopes"]
        packed[:, 8:12] = scene["features"][:, :4]
        packed[:, 12:14] = np.sqrt(np.maximum(reach[:, None] * np.stack([c, a], -1), 0.0))
        packed[:, 14] = np.log(np.maximum(opacity, 1e-30))
        self.splats = Splats(
            rows=wp.array(packed, dtype=vec16, device=device),
            depths=wp.array(scene["depths"], dtype=float, device=device),
            tile_rects=wp.array(rects, dtype=wp.vec4i, device=device),
        )
        self.identities = None
        if channels == 20:
            self.identities = wp.array(scene["features"][:, 4:], dtype=vec16, device=device)
        self.tiles = allocate_tiles(n, self.slots, width=self.width, height=self.height, device=device)
        bin_splats(
            self.splats.tile_rects,
            self.splats.depths,
            count=n,
            width=self.width,
            height=self.height,
            out=self.tiles,
        )
        shape = (rows * 16, columns * 16)
        self.image = wp.full((channels, *shape), 7.0, dtype=float, device=device)
        self.transmittance = wp.full(shape, 7.0, dtype=float, device=device)
        self.median_depth = wp.full(shape, 7.0, dtype=float, device=device)
        self.forward()

    def forward(self):
        composite(
            self.splats,
            self.tiles,
            width=self.width,
            height=self.height,
            image=self.image,
            transmittance=self.transmittance,
            median_depth=self.median_depth,
            identities=self.identities,
            sample=self.sample,
            cooperative=self.cooperative,
        )

    def planes(self):
        """Image, transmittance and median depth without padding."""
        arrays = (self.image, self.transmittance, self.median_depth)
        return tuple(a.numpy()[..., : self.height, : self.width].copy() for a in arrays)

    def adjoint(self, d_image, d_transmittance, **options):
        """Gradients of means2d, conics, slopes and features, summed over slots; they start as garbage."""
        padding = [(0, p - s) for p, s in zip(self.transmittance.shape, d_transmittance.shape, strict=True)]
        garbage = [wp.full(self.slots, vec16(9.0), dtype=vec16, device=self.device) for _ in range(2)]
        out = SlotGradients(garbage[0], None if self.identities is None else garbage[1])
        composite_adjoint(
            self.splats,
            self.tiles,
            image=self.image,
            transmittance=self.transmittance,
            d_image=wp.array(np.pad(d_image, [(0, 0), *padding]), dtype=float, device=self.device),
            d_transmittance=wp.array(np.pad(d_transmittance, padding), dtype=float, device=self.device),
            out=out,
            identities=self.identities,
            sample=self.sample,
            cooperative=self.cooperative,
            **options,
        )
        owners = self.tiles.slot_gaussians.numpy()[: self.slots]
        rows = np.concatenate([a.numpy() for a in (out.rows, out.identities) if a is not None], axis=1)
        total = np.zeros((self.splats.depths.shape[0], rows.shape[1]))
        np.add.at(total, owners, rows)
        self.weights = total[:, 12]
        assert not total[:, 13:16].any()
        features = np.concatenate([total[:, 8:12], total[:, 16:]], axis=1)
        return [total[:, 4:6], total[:, :4], total[:, 6:8], features]


def oracle(scene, size, d_image=None, d_transmittance=None):
    """Planes of the float64 oracle, and gradients if asked for."""
    tensors = {k: torch.from_numpy(v).double().requires_grad_(k != "depths") for k, v in scene.items()}
    planes = composite_reference(**tensors, width=size[0], height=size[1])
    values = tuple(p.detach().numpy() for p in planes)
    if d_image is None:
        return values
    loss = (planes[0] * torch.from_numpy(d_image)).sum() + (
        planes[1] * torch.from_numpy(d_transmittance)
    ).sum()
    grads = torch.autograd.grad(loss, [tensors[k] for k in NAMES])
    return values, [g.numpy() for g in grads]


def random_gradients(rng, channels, size):
    width, height = size
    return rng.normal(size=(channels, height, width)).astype(np.float32), rng.normal(
        size=(height, width)
    ).astype(np.float32)


def assert_same_direction(ours, theirs, tolerance=2e-4):
    """Relative L2, cosine and signed bias of two gradients."""
    ours, theirs = ours.ravel().astype(np.float64), theirs.ravel()
    scale = np.linalg.norm(theirs)
    assert np.isfinite(ours).all() and scale > 0
    assert np.linalg.norm(ours - theirs) <= tolerance * scale
    assert ours @ theirs / (np.linalg.norm(ours) * scale) >= 0.999
    assert abs((ours - theirs).sum()) <= tolerance * np.abs(theirs).sum()
