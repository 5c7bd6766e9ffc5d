# SPDX-License-Identifier: Apache-2.0
"""A scene of stated size: so many Gaussians of so many pixels in one view, and what it asks of a renderer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.optim.adam import AdamRates
from ggwarp.kernels.raster.project import LOW_PASS
from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.objects.classifier import ClassifierConfig, random_identities
from ggwarp.objects.masks.mask_supervision import SupervisionConfig
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig
from ggwarp.pipeline.mapping.seeding import SeedingConfig
from ggwarp.types import Float64, Frame

OBJECTS = 50
"""Objects in the view's mask: about as many as a furnished room has."""

_NEAREST, _FARTHEST = 1.0, 4.0
_ROUGHNESS = 0.02  # of the surface, as a share of its depth
_STRETCH, _FLATNESS = 1.5, 0.3
_FACING = 1.2  # seen from a random side, such an ellipsoid is so much smaller than face on
_OPACITIES = 0.15, 0.8
_TILE, _LOW_PASS = 16, float(LOW_PASS)
_ALPHA_MAX, _ALPHA_MIN, _T_MIN = 0.99, 1.0 / 255.0, 1e-4


def scene_camera(width: int, height: int) -> Camera:
    """Return a camera of that size with Replica's field of view (90 degrees across)."""
    return Camera(width, height, width / 2.0, width / 2.0, (width - 1) / 2.0, (height - 1) / 2.0)


def covering_size(gaussians: int, width: int, height: int) -> float:
    """Return the size, pixels, at which ``gaussians`` cover such a view as 20,000 of 2 pixels do 320x180.

    The rasteriser's low-pass filter is counted in; where it alone covers more, Gaussians become points.
    """
    share = (width * height) / (320 * 180) * 20_000 / gaussians
    return max((2.0**2 + _LOW_PASS) * share - _LOW_PASS, 0.01) ** 0.5


def scene_gaussians(count: int, camera: Camera, *, size: float, identity: bool, seed: int = 0) -> Gaussians:
    """Return ``count`` Gaussians spread evenly over the view of a camera at the world's origin.

    They lie about a wavy surface, 1 to 4 m away, all at different depths; orientations are random; the
    ellipsoids are stretched (1 : 0.44 : 0.2), opacities 0.15 to 0.8.

    Args:
        count: Gaussians.
        camera: the view.
        size: of a splat, pixels: about the median over the splats of the geometric mean of their two
            standard deviations.
        identity: whether they have identities.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    # Beyond the border, too: pixels there are covered as those in the middle.
    margin = 2.0 * size
    u = rng.uniform(-margin, camera.width - 1 + margin, count)
    v = rng.uniform(-margin, camera.height - 1 + margin, count)
    wave = v / camera.height + 0.2 * np.sin(4.0 * np.pi * u / camera.width)
    z = np.empty(count)
    z[np.argsort(wave + rng.normal(scale=_ROUGHNESS, size=count))] = np.linspace(_NEAREST, _FARTHEST, count)
    means = camera.back_project(u, v, z)
    quats = rng.normal(size=(count, 4))
    sigma = _FACING * size * z / camera.fx
    scales = sigma[:, None] * np.array([_STRETCH, 1.0 / _STRETCH, _FLATNESS])
    opacities = rng.uniform(*_OPACITIES, count)
    return Gaussians(
        means=means.astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        log_scales=np.log(scales).astype(np.float32),
        opacity_logits=np.log(opacities / (1.0 - opacities)).astype(np.float32),
        colours=((rng.uniform(0.05, 0.95, (count, 3)) - 0.5) / SH_C0).astype(np.float32),
        identities=random_identities(count, rng) if identity else None,
    )


def scene_mapper(gaussians: Gaussians, camera: Camera, *, device: Any) -> tuple[Mapper, Frame]:
    """Return a mapper whose map is ``gaussians``, with one keyframe: their own view, made noisy.

    All of an iteration is done, but learning rates are 0: each iteration sees the same scene.
    """
    config = MapperConfig(
        seeding=SeedingConfig(min_density=0.0, max_density=0.0),
        classifier=ClassifierConfig(rate=0.0),
        supervision=SupervisionConfig(votes=0),
    )
    still = AdamRates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    mapper = build_mapper(
        config, camera, device=device, use_identity=gaussians.identities is not None, rates=still
    )
    mapper.map.append(gaussians)
    view = mapper.render(np.eye(4))
    noise = np.random.default_rng(1).normal(scale=8.0, size=view.rgb.shape)
    frame = Frame(
        index=0,
        timestamp=0.0,
        rgb=np.clip(255.0 * view.rgb + noise, 0.0, 255.0).astype(np.uint8),
        depth=np.maximum(view.surface_depth, np.float32(_NEAREST)),
        mask=object_mask(camera),
        T_wc=np.eye(4),
    )
    mapper.insert(frame, np.eye(4))
    return mapper, frame


def object_mask(camera: Camera) -> Any:
    """Return [h, w] int32: the view cut into :data:`OBJECTS` blocks, ids from 1."""
    columns, rows = OBJECTS // 5, 5
    x = np.arange(camera.width) * columns // camera.width
    y = np.arange(camera.height) * rows // camera.height
    return (1 + x + columns * y[:, None]).astype(np.int32)


@dataclass(frozen=True)
class Load:
    """What one view asks of a renderer.

    Attributes:
        gaussians, visible: in the map, in the view.
        pairs: of splats and tiles.
        footprint: median size of a splat, pixels: the geometric mean of its two standard deviations.
        per_pixel: contributions a pixel: splats with alpha >= 1/255 there and T >= 1e-4 before them.
        contributions: of the whole view.
    """

    gaussians: int
    visible: int
    pairs: int
    footprint: float
    per_pixel: float
    contributions: float

    @property
    def pairs_per_splat(self) -> float:
        return self.pairs / max(self.visible, 1)


def load_of(splats: Any, tiles: Any, camera: Camera, count: int, *, most_tiles: int = 256) -> Load:
    """Count what a view asks for, from its projection and binning, in NumPy.

    Args:
        splats: :class:`ggwarp.kernels.raster.project.Splats`, of ``count`` Gaussians.
        tiles: :class:`ggwarp.kernels.raster.tiles.TileArrays`.
        camera: the view.
        most_tiles: contributions are counted on so many tiles at most, evenly picked.
    """
    visible, pairs = tiles.counts.numpy()[:2].tolist()
    means, conics = splats.means2d.numpy(), splats.conics.numpy()
    lists = tiles.slot_gaussians.numpy()[tiles.pair_slots.numpy()[:pairs]]
    ranges = tiles.tile_ranges.numpy()
    across = -(-camera.width // _TILE)
    picked = np.unique(np.linspace(0, len(ranges) - 1, min(most_tiles, len(ranges))).round().astype(int))
    counted = pixels = 0
    for tile in picked:
        y, x = divmod(int(tile), across)
        u = np.arange(x * _TILE, min((x + 1) * _TILE, camera.width))
        v = np.arange(y * _TILE, min((y + 1) * _TILE, camera.height))
        here = lists[ranges[tile][0] : ranges[tile][1]]
        counted += _contributions(means[here], conics[here], u, v)
        pixels += len(u) * len(v)
    seen = tiles.visible.numpy()[:visible]
    determinants = conics[seen, 0] * conics[seen, 2] - conics[seen, 1] ** 2
    per_pixel = counted / pixels
    return Load(
        gaussians=count,
        visible=visible,
        pairs=pairs,
        footprint=float(np.median(determinants**-0.25)) if visible else 0.0,
        per_pixel=per_pixel,
        contributions=per_pixel * camera.width * camera.height,
    )


def _contributions(means: Float64, conics: Float64, u: Any, v: Any) -> int:
    """Count the contributions of splats, front to back, to the pixels ``u`` x ``v``."""
    dx = (u[None, :] - means[:, :1])[:, None, :]
    dy = (v[None, :] - means[:, 1:])[:, :, None]
    a, b, c, opacity = (conics[:, k, None, None] for k in range(4))
    alpha = np.minimum(opacity * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy), _ALPHA_MAX)
    alpha[alpha < _ALPHA_MIN] = 0.0
    behind = np.cumprod(1.0 - alpha, axis=0)
    before = np.concatenate([np.ones_like(behind[:1]), behind[:-1]])
    return int(np.count_nonzero((alpha > 0.0) & (before >= _T_MIN)))
