# SPDX-License-Identifier: Apache-2.0
"""Where a keyframe adds Gaussians, and what they start as.

Gaussians go where the map does not yet explain the picture: everywhere at first, later where
the render is transparent, behind the new surface, or wrong in colour. Their density follows
the picture's detail, and their size follows their density, so that they tile the surface.
What lies on the surface already counts: edges look new in every view, by a pixel or two, and what cannot be
fitted stays wrong in colour, so that a map that was seeded there each time would grow for ever.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.math import vec16
from ggwarp.kernels.seeding.density import DensityRules, allocate_seeding, density_of_seeds
from ggwarp.kernels.seeding.seeds import (
    SeedRules,
    begin_gaussians,
    begin_identities,
    choose_pixels,
    smoothed_depth,
)
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import SH_C0
from ggwarp.map.renderer import Planes
from ggwarp.map.surface_density import surface_density
from ggwarp.objects.classifier import IdentitySeeds
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float64

_DETAIL_GAIN = 6.0
"""Density added per unit of local colour contrast (0..1)."""
_RESIDUAL_THRESHOLD = 0.06
"""On surface that the map shows, more are added where the mean absolute colour error is above this."""
_RESIDUAL_GAIN = 1.5
"""Density added per unit of colour error above the threshold."""
DEPTH_TOLERANCE = 0.03
"""A surface is new when it is closer than the rendered depth by more than this share of it, and a Gaussian
lies on a surface whose depth is its own to this share."""
_MOST = 1.0
"""Gaussians a pixel that a wrong colour may lead to: a view cannot tell more apart."""
_SPACING = 0.5
"""Standard deviation of a Gaussian in units of the distance to its neighbours."""
_FLATNESS = 0.2
"""Standard deviation along the surface normal, relative to the tangential one."""
_MAX_STRETCH = 3.0
"""A Gaussian on a grazing surface is stretched by 1/cos, at most by this."""
_OPACITY = 0.7


@dataclass(frozen=True)
class SeedingConfig:
    """How densely Gaussians are laid, and what they start as."""

    min_density: float = 0.3
    """Gaussians a pixel on new surface without texture."""
    max_density: float = 0.7
    """Gaussians a pixel on new surface with fine texture."""
    identity_noise: float = 0.1
    """Spread of initial identities round their object's code. With 1 they are random, as in GG-SLAM
    eq. (2)."""


@dataclass(frozen=True)
class Seen:
    """A keyframe on the device, as new Gaussians are laid by it.

    Attributes:
        index: the frame's.
        pixels: [h, w, 3] uint8, the picture.
        depth: [h, w] float, metres, 0 = none.
        T_wc: [4, 4] pose.
        exposure: [1] vec6, of the picture, see :mod:`ggwarp.kernels.photometric.affine_exposure`.
        rendered: the map's view from there; None while the map is empty.
    """

    index: int
    pixels: Any
    depth: Any
    T_wc: Float64
    exposure: Any
    rendered: Planes | None


class Seeder:
    """Adds to a map the Gaussians that a keyframe shows and the map lacks (GG-SLAM 2.3, c)."""

    def __init__(self, config: SeedingConfig, camera: Camera, gaussians: GaussianMap, *, flat: bool) -> None:
        """Prepare to add to ``gaussians`` what pictures of ``camera`` show.

        Args:
            flat: Gaussians are discs on the surface; else they are round, as where normals are not known.
        """
        self._config = config
        self._camera = camera
        self._intrinsics = intrinsics_of(camera)
        self._map = gaussians
        self._device = gaussians.device
        self._workspace = allocate_seeding(camera.height, camera.width, device=self._device)
        self._density_rules = DensityRules()
        rules = self._density_rules
        rules.least, rules.most, rules.full = config.min_density, config.max_density, _MOST
        rules.detail_gain, rules.tolerance = _DETAIL_GAIN, DEPTH_TOLERANCE
        rules.residual_gain, rules.residual_threshold = _RESIDUAL_GAIN, _RESIDUAL_THRESHOLD
        self._seed_rules = SeedRules()
        begun = self._seed_rules
        begun.spacing, begun.noise, begun.colour_scale = _SPACING, config.identity_noise, SH_C0
        begun.flatness, begun.stretch = (_FLATNESS, _MAX_STRETCH) if flat else (1.0, 1.0)
        begun.opacity_logit = math.log(_OPACITY / (1.0 - _OPACITY))

    def seed(
        self, seen: Seen, keyframe_id: int, identities: IdentitySeeds | None, rng: np.random.Generator
    ) -> int:
        """Add what ``seen`` shows and the map lacks; return how many Gaussians that is.

        Args:
            keyframe_id: number of the keyframe.
            identities: what they begin as; None: the map has none.
            rng: draws the identities.
        """
        present = self._present(seen)
        return self.add(seen, self.density(seen, present), present, keyframe_id, identities, rng)

    def density(self, seen: Seen, present: Any = None) -> Any:
        """Return the density of new Gaussians, [h, w] Gaussians a pixel, on the device, until the next call.

        Args:
            present: [h, w] Gaussians a pixel on the surface already; None: none.
        """
        rendered = seen.rendered
        density_of_seeds(
            self._density_rules,
            pixels=seen.pixels,
            exposure=seen.exposure,
            depth=seen.depth,
            image=None if rendered is None else rendered.image,
            median_depth=None if rendered is None else rendered.median_depth,
            transmittance=None if rendered is None else rendered.transmittance,
            present=present,
            workspace=self._workspace,
            device=self._device,
        )
        return self._workspace.density

    def add(
        self,
        seen: Seen,
        density: Any,
        present: Any,
        keyframe_id: int,
        identities: IdentitySeeds | None,
        rng: np.random.Generator,
    ) -> int:
        """Add Gaussians at ``density`` [h, w] between those ``present``; otherwise as :meth:`seed`."""
        device, workspace = self._device, self._workspace
        chosen, numbers, smooth = workspace.chosen, workspace.numbers, workspace.smooth_depth
        choose_pixels(density, frame=seen.index, chosen=chosen, numbers=numbers, device=device)
        count = int(to_host(numbers[-1, -1:])[0])
        begin = self._map.extend(count)
        if count == 0:
            return 0
        smoothed_depth(seen.depth, smooth=smooth, device=device)
        begin_gaussians(
            self._seed_rules,
            begin=begin,
            pixels=seen.pixels,
            exposure=seen.exposure,
            depth=seen.depth,
            smooth=smooth,
            camera=self._intrinsics,
            T_wc=wp.array(seen.T_wc.astype(np.float32)[None], dtype=wp.mat44, device=device),
            density=density,
            present=present,
            chosen=chosen,
            numbers=numbers,
            outputs=self._map.fields,
            device=device,
        )
        self._map.fields["keyframe_ids"][begin : begin + count].fill_(keyframe_id)
        if identities is not None:
            begin_identities(
                self._seed_rules,
                begin=begin,
                chosen=chosen,
                numbers=numbers,
                seed=int(rng.integers(2**31)),
                codes=wp.array(identities.codes, dtype=vec16, device=device),
                classes=identities.classes,
                labels=identities.votes,
                identities=self._map.fields["identities"],
                votes=self._map.fields["votes"],
                device=device,
            )
        return count

    def _present(self, seen: Seen) -> Any:
        if seen.rendered is None:
            return None
        return surface_density(self._map, seen.T_wc, self._camera, seen.depth, tolerance=DEPTH_TOLERANCE)
