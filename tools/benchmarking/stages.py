# SPDX-License-Identifier: Apache-2.0
"""The stages of a mapping iteration, each to be run alone, and the work each must do at least."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from benchmarking.inputs.scene import Load, load_of
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.losses.rgbd import LOSS_COUNT, rgbd_loss
from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.adam import AdamRates, adam_gaussians
from ggwarp.kernels.raster.composite import composite, composite_adjoint
from ggwarp.kernels.raster.project import project
from ggwarp.kernels.raster.project_adjoint import project_adjoint
from ggwarp.kernels.raster.tiles import bin_splats
from ggwarp.kernels.workspaces import allocate_loss, allocate_slot_gradients, allocate_splats
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.mapping.mapper import Mapper
from ggwarp.runtime.graphs import GraphCache
from ggwarp.types import Frame

RENDERING = ("project", "bin", "composite", "composite adjoint", "project adjoint")
"""Forward and complete adjoint."""


class Stages:
    """The stages on one mapper's map, in arrays of their own.

    Attributes:
        load: what the view asks for.
        channels: 4 or 20.
        stride: identities are rendered, as the mapper does, on a share of 1 / stride of the pixels.
    """

    def __init__(self, mapper: Mapper, frame: Frame, camera: Camera) -> None:
        self._map, self._camera = mapper.map, camera
        objects = mapper.objects
        self._classifier = None if objects is None else objects.classifier
        self._device = mapper.map.device
        self._renderer = Renderer(mapper.map, camera)
        self._T_cw = self._renderer.pose_array(np.eye(4))
        self._renderer.provide(self._T_cw)
        self._renderer.forward(self._T_cw)
        self._intrinsics = intrinsics_of(camera)
        self.channels = self._renderer.image.shape[0]
        self._splats = allocate_splats(self._map.count, device=self._device)
        self._slots = allocate_slot_gradients(
            self._renderer.tiles.capacity, self.channels, device=self._device
        )
        self._graphs = GraphCache(self._device)
        self._losses = self._array(np.zeros(LOSS_COUNT), float)
        self._workspace = allocate_loss(camera.height, camera.width, device=self._device)
        self._colour, self._depth = self._array(frame.rgb, wp.uint8), self._array(frame.depth, float)
        self._labels = None
        if objects is not None and frame.mask is not None:
            self._labels = self._array(objects.classes.encode(frame.mask), int)
        self._sample = None if self._classifier is None else self._classifier.draw_sample(self._labels)
        self.stride = 1 if self._sample is None else self._sample.stride
        self._rates = self._array(AdamRates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0).lanes(), vec16)
        for work in self.works().values():
            work()
        self.load = load_of(self._splats, self._renderer.tiles, camera, self._map.count)

    def works(self) -> dict[str, Callable[[], object]]:
        """Return name -> stage, in the order of an iteration; all can be repeated."""
        with_identity = self._classifier is not None
        stages: dict[str, Callable[[], None]] = {
            "project": self._project,
            "bin": self._bin,
            "composite": self._composite,
            "loss": self._loss,
            **({"cross-entropy": self._cross_entropy} if with_identity else {}),
            "composite adjoint": self._composite_adjoint,
            "project adjoint": self._project_adjoint,
            **({"KL": self._divergence} if with_identity else {}),
            "Adam": self._adam,
        }
        works: dict[str, Callable[[], object]] = {}
        works |= {name: partial(self._run, name, stage) for name, stage in stages.items()}
        if with_identity:
            works["KL"] = self._draw_and_compare
        return works

    def forward_and_adjoint(self) -> None:
        """Render and take the gradient back, identities everywhere."""
        self._run("forward and adjoint", self._pass)

    def sampled_forward_and_adjoint(self) -> None:
        """Render and take the gradient back, as the mapper does."""
        self._run("sampled forward and adjoint", self._sampled_pass)

    def _run(self, name: str, stage: Callable[[], None]) -> None:
        """Do a stage; on CUDA by replaying a recording, as the mapper does."""
        if self._device.is_cpu:
            stage()
        else:
            self._graphs.run(name, stage, arrays=self._renderer.allocation)

    def _pass(self) -> None:
        self._renderer.forward(self._T_cw)
        self._renderer.adjoint(self._T_cw)

    def _sampled_pass(self) -> None:
        self._renderer.forward(self._T_cw, sample=self._sample)
        self._renderer.adjoint(self._T_cw)

    def _array(self, values: Any, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self._device)

    def _project(self) -> None:
        m = self._map.parameters
        project(
            m.means, m.quats, m.log_scales, m.opacity_logits, m.colours, m.identities,
            T_cw=self._T_cw, camera=self._intrinsics, count=self._map.count, out=self._splats,
        )  # fmt: skip

    def _bin(self) -> None:
        size = {"width": self._camera.width, "height": self._camera.height}
        bin_splats(
            self._splats.tile_rects,
            self._splats.depths,
            count=self._map.count,
            **size,
            out=self._renderer.tiles,
        )

    def _composite(self) -> None:
        r = self._renderer
        if self._classifier is not None:
            self._classifier.draw_sample(self._labels)
        composite(
            self._splats,
            r.tiles,
            width=self._camera.width,
            height=self._camera.height,
            image=r.image,
            transmittance=r.transmittance,
            median_depth=r.median_depth,
            identities=self._map.parameters.identities,
            sample=self._sample,
        )

    def _loss(self) -> None:
        rgbd_loss(
            self._renderer.image,
            self._colour,
            self._depth,
            d_image=self._renderer.d_image,
            losses=self._losses,
            workspace=self._workspace,
            device=self._device,
        )

    def _cross_entropy(self) -> None:
        assert self._classifier is not None
        self._classifier.evaluate(self._renderer, self._labels, self._losses)

    def _composite_adjoint(self) -> None:
        r = self._renderer
        composite_adjoint(
            self._splats,
            r.tiles,
            image=r.image,
            transmittance=r.transmittance,
            d_image=r.d_image,
            d_transmittance=r.d_transmittance,
            out=self._slots,
            identities=self._map.parameters.identities,
            sample=self._sample,
        )

    def _project_adjoint(self) -> None:
        m, g = self._map.parameters, self._renderer.gradients
        project_adjoint(
            m.means, m.quats, m.log_scales, m.opacity_logits, m.colours,
            T_cw=self._T_cw, camera=self._intrinsics, count=self._map.count,
            tiles=self._renderer.tiles, slots=self._slots,
            d_means=g.means, d_quats=g.quats, d_log_scales=g.log_scales,
            d_opacity_logits=g.opacity_logits, d_colours=g.colours, d_identities=g.identities,
        )  # fmt: skip

    def _draw_and_compare(self) -> None:
        assert self._classifier is not None
        self._classifier.sample_3d()
        self._run("KL", self._divergence)

    def _divergence(self) -> None:
        assert self._classifier is not None
        self._classifier.evaluate_3d(self._renderer, self._losses)

    def _adam(self) -> None:
        adam_gaussians(
            self._map.parameters,
            self._renderer.gradients,
            self._map.adam_state,
            rates=self._rates,
            ranks=self._renderer.ranks,
            device=self._device,
        )


def view_load(gaussians: GaussianMap, camera: Camera) -> Load:
    """Return what the view of a map from the world's origin asks for."""
    renderer = Renderer(gaussians, camera)
    T_cw = renderer.pose_array(np.eye(4))
    renderer.provide(T_cw)
    renderer.forward(T_cw)
    splats = allocate_splats(gaussians.count, device=gaussians.device)
    m = gaussians.parameters
    project(
        m.means, m.quats, m.log_scales, m.opacity_logits, m.colours, m.identities,
        T_cw=T_cw, camera=intrinsics_of(camera), count=gaussians.count, out=splats,
    )  # fmt: skip
    return load_of(splats, renderer.tiles, camera, gaussians.count)


@dataclass(frozen=True)
class Effort:
    """The least that a stage must do.

    Attributes:
        gflop: arithmetic in 1e9, as the equations need it; None: none to speak of.
        gigabytes: traffic, every array read or written once, splats once a pair.
    """

    gflop: float | None
    gigabytes: float


def efforts(load: Load, camera: Camera, channels: int, classes: int, stride: int = 1) -> dict[str, Effort]:
    """Return name of the stage -> its effort.

    C channels, those of the identity counted by the share of pixels that have them, 1 / ``stride``: a
    contribution costs 32 + 2 C operations forward (distance and exponent 10, exp as a polynomial 13,
    weight, transmittance and depth 9, channels 2 C) and 58 + 4 C in the adjoint (the weight again,
    gradients of conic, mean, slope and opacity; channels' gradients 2 C, their product with the image's
    2 C); a pixel 1,150 for SSIM with its adjoint, separable; 7 for each class and 16 lanes of the
    cross-entropy; an Adam step 15 a parameter.
    """
    n, v, p = load.gaussians, load.visible, load.pairs
    pixels = camera.width * camera.height
    identity = 16 if channels == 20 else 0
    parameters = 14 + identity
    c = 4 + identity / stride
    splat = 12 + identity  # floats: centre 2, conic and opacity 4, slope 2, channels
    floats = {
        "project": n * (parameters + 4) + v * (splat + 1),
        "bin": n * 4 + v * 3 + p * 2,
        "composite": p * (splat + 2) + pixels * (c + 2),
        "loss": pixels * (4 + 1 + 1 + 4),
        "cross-entropy": pixels / stride * (16 + 16 + 1),
        "composite adjoint": p * (2 * splat + 2) + pixels * 2 * (c + 1),
        "project adjoint": p * splat + v * (14 + parameters),
        "KL": 6000 * 4 * 16,
        "Adam": v * parameters * 7,
    }
    operations = {
        "composite": load.contributions * (32 + 2 * c),
        "loss": pixels * 1150,
        "cross-entropy": pixels / stride * classes * 7 * 16,
        "composite adjoint": load.contributions * (58 + 4 * c),
        "Adam": v * parameters * 15,
    }
    return {
        name: Effort(operations[name] / 1e9 if name in operations else None, 4 * count / 1e9)
        for name, count in floats.items()
    }
