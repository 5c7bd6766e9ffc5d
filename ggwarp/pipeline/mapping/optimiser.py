# SPDX-License-Identifier: Apache-2.0
"""Fitting the map to its keyframes: one view an iteration, Adam on what it shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.kernels.losses.isotropy import pull_round
from ggwarp.kernels.losses.rgbd import DEPTH, DSSIM, L1, LOSS_COUNT, OBJECT, OBJECT_3D, add_total, rgbd_loss
from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.adam import AdamRates, adam_gaussians
from ggwarp.kernels.optim.compact import count_low_weight, flag_kept
from ggwarp.kernels.optim.pose_adam import step_pose
from ggwarp.kernels.workspaces import allocate_loss
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.objects.classifier import Classifier, ClassifierConfig
from ggwarp.pipeline.mapping.densification import DensifyConfig, densify_gaussians
from ggwarp.pipeline.mapping.exposure import Exposing
from ggwarp.pipeline.mapping.keyframe import EXPOSURE, POSE, Keyframe, Stage
from ggwarp.pipeline.mapping.keyframe_sampler import KeyframeSampler
from ggwarp.runtime.graphs import GraphCache
from ggwarp.runtime.streams import Backlog, to_host
from ggwarp.types import Exposure, Float64

_RATES = AdamRates(means=2e-4, quats=2e-2, log_scales=2.5e-2, opacity=0.2, colours=1e-2, identities=2.5e-2)


@dataclass(frozen=True)
class OptimiserConfig:
    """What the map is fitted to, and how fast."""

    colour_weight: float = 1.0
    """l_rgb of the loss (GG-SLAM eq. 5)."""
    dssim: float = 0.2
    """Share of 1 - SSIM in the colour loss (eq. 6)."""
    depth_weight: float = 4.0
    """l_d of the loss; the paper's 0.1 leaves surfaces free to drift along the view for colour's sake."""
    depth_max: float = 10.0
    """Depth unit of eq. 7, metres."""
    isotropic_weight: float = 0.0
    """Pull towards round Gaussians: loss by a pixel's share of each, per metre that its axes differ (MonoGS
    eq. 10 has 10, by each Gaussian's share); not in the reported loss."""
    rates: AdamRates = _RATES
    """Adam's learning rates: larger than GS-ICP-SLAM's, as each Gaussian gets tens of steps here, not
    thousands."""
    rate_decay: float = 100.0
    """A Gaussian's rates fall by 1 / sqrt(1 + t / this) over its steps t, so that it settles between views
    that disagree a little, as a real camera's do; 0: rates stay, as they must where poses still move."""
    pose_rates: tuple[float, float] = (0.0, 0.0)
    """Adam's learning rates of the keyframes' poses, metres and radians; 0: poses stay as tracked."""
    exposure_rate: float = 0.0
    """Adam's learning rate of the keyframes' exposures; 0: pictures are taken as they are."""
    exposure_pull: float = 0.01
    """Weight of an exposure's squared size in the loss: keeps the map's brightness from drifting away."""
    prune_interval: int = 200
    """Prune every so many iterations."""
    prune_opacity: float = 0.005
    """Gaussians less opaque than this are pruned."""
    prune_scale: float = 0.25
    """Gaussians with a larger standard deviation than this are pruned, metres."""
    prune_idle: int = 20
    """Gaussians that made up next to nothing of each of the last so many views that could show them are
    pruned, as they are hidden; 0: they stay."""
    prune_weight: float = 0.05
    """Fewer pixels of a view than this are next to nothing."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    classifier: ClassifierConfig = field(default_factory=ClassifierConfig)


class MapOptimiser:
    """Fits a map to keyframes; the map's writer calls it.

    Attributes:
        keyframes: on the device, in the order in which they came.
        iterations: so far.
    """

    def __init__(
        self,
        config: OptimiserConfig,
        gaussians: GaussianMap,
        renderer: Renderer,
        classifier: Classifier | None,
        drawing: KeyframeSampler,
        *,
        recorded: bool | None = None,
    ) -> None:
        """Prepare to fit ``gaussians`` to keyframes of the renderer's camera.

        Args:
            drawing: which keyframe an iteration is spent on.
            recorded: see :class:`ggwarp.pipeline.mapping.mapper.Mapper`.
        """
        self._config = config
        self._map = gaussians
        self._device = gaussians.device
        self._renderer = renderer
        self._classifier = classifier
        self._sampler = drawing
        camera = renderer.camera
        self._workspace = allocate_loss(camera.height, camera.width, device=self._device)
        self._exposing = (
            Exposing(renderer, rate=config.exposure_rate, pull=config.exposure_pull)
            if config.exposure_rate > 0.0
            else None
        )
        self._losses = wp.zeros(LOSS_COUNT, dtype=float, device=self._device)
        self._loss_weights = wp.array(_loss_weights(config), dtype=float, device=self._device)
        self._totals = wp.zeros(2, dtype=wp.float64, device=self._device)
        self._backlog = Backlog(self._device)
        self._recorded = self._device.is_cuda if recorded is None else recorded
        self._graphs, self._stage = GraphCache(self._device), Stage()
        self._rates = wp.array(config.rates.lanes(), dtype=vec16, device=self._device)
        self.iterations = 0
        self.keyframes: list[Keyframe] = []

    def add(self, keyframe: Keyframe) -> None:
        """Fit the map to ``keyframe``, too."""
        self.keyframes.append(keyframe)
        self._sampler.add()
        if self._recorded:
            self._renderer.provide(keyframe.T_cw)

    def pose(self, number: int) -> Float64:
        """Return the camera-to-world pose [4, 4] of keyframe ``number`` as it is now."""
        return se3.inverse(se3.orthonormalised(to_host(self.keyframes[number].T_cw)[0].astype(np.float64)))

    def exposure(self, number: int) -> Exposure:
        """Return the exposure of keyframe ``number`` as it is now."""
        values = to_host(self.keyframes[number].exposure)[0].tolist()
        return Exposure(tuple(values[:3]), tuple(values[3:]))

    def iterate(self) -> None:
        """Fit the map to one keyframe once; on CUDA, queue it: the host reads nothing."""
        number = self._sampler.draw()
        keyframe = self.keyframes[number]
        with_3d = self._classifier is not None and self._classifier.begin_3d(self.iterations)
        # The first keyframe holds the world in place, and its brightness.
        with_pose = number > 0 and any(self._config.pose_rates)
        with_exposure = number > 0 and self._config.exposure_rate > 0.0
        change = (POSE if with_pose else ()) + (EXPOSURE if with_exposure else ())
        if self._recorded:
            staged = self._stage.load(keyframe)
            variant = (staged.has_depth, staged.labels is not None, with_3d, change)
            self._graphs.run(variant, lambda: self._fit(staged, with_3d, change), arrays=self._allocation)
            self._stage.store(keyframe, change)
        else:
            self._fit(keyframe, with_3d, change)
        self._backlog.added()
        self.iterations += 1
        if self.iterations % self._config.prune_interval == 0:
            self._prune()
        d = self._config.densify
        if d.interval > 0 and self.iterations > d.offset and (self.iterations - d.offset) % d.interval == 0:
            densify_gaussians(self._map, d, np.random.default_rng((5, self.iterations)))
            self._renderer.make_room()

    def synchronise(self) -> float:
        """Wait for the iterations since the last call; return their mean loss, NaN where there were none."""
        total, count = to_host(self._totals).tolist()
        self._totals.zero_()
        self._renderer.make_room()
        return total / count if count else math.nan

    @property
    def _allocation(self) -> tuple[int, ...]:
        """Changes when a recorded iteration no longer holds."""
        classes = self._classifier.count if self._classifier is not None else 0
        return (self._map.allocation, self._renderer.allocation, classes)

    def _fit(self, keyframe: Keyframe, with_3d: bool, change: tuple[str, ...]) -> None:
        """One iteration: render, compare, take the gradient back, step. It only launches: it is recorded."""
        with_pose = "T_cw" in change
        sample = None if self._classifier is None else self._classifier.draw_sample(keyframe.labels)
        self._renderer.forward(keyframe.T_cw, sample=sample)
        if self._exposing is not None and "exposure" in change:
            self._exposing.show(keyframe)
            self._evaluate(keyframe, self._exposing.image)
            self._exposing.step(keyframe)
        else:
            self._evaluate(keyframe, self._renderer.image)
        self._renderer.adjoint(
            keyframe.T_cw, pose=with_pose, mean2d_gradient_norms=self._config.densify.interval > 0
        )
        if self._classifier is not None and with_3d:
            self._classifier.evaluate_3d(self._renderer, self._losses)
        if self._config.isotropic_weight > 0.0:
            self._pull_round()
        if self._config.prune_idle > 0:
            self._count_idle()
        self._step()
        if with_pose:
            self._step_pose(keyframe)
        add_total(self._losses, weights=self._loss_weights, totals=self._totals, device=self._device)

    def _evaluate(self, keyframe: Keyframe, image: wp.array) -> None:
        """Write the loss and its gradient by ``image``, the render as exposed (GG-SLAM eq. 5)."""
        c = self._config
        rgbd_loss(
            image,
            keyframe.colour,
            keyframe.depth,
            d_image=self._renderer.d_image,
            losses=self._losses,
            workspace=self._workspace,
            colour_weight=c.colour_weight,
            dssim=c.dssim,
            depth_weight=c.depth_weight,
            d_max=c.depth_max,
            mask_colour=keyframe.has_depth,
            device=self._device,
        )
        if self._classifier is not None:
            self._classifier.evaluate(self._renderer, keyframe.labels, self._losses)

    def _pull_round(self) -> None:
        camera, rows = self._renderer.camera, self._renderer.rows
        pull_round(
            self._map.parameters.log_scales,
            ranks=self._renderer.ranks,
            weight=self._config.isotropic_weight / (camera.width * camera.height),
            d_log_scales=self._renderer.gradients.log_scales[:rows],
            device=self._device,
        )

    def _step(self) -> None:
        adam_gaussians(
            self._map.parameters,
            self._renderer.gradients,
            self._map.adam_state,
            rates=self._rates,
            ranks=self._renderer.ranks,
            device=self._device,
            decay=self._config.rate_decay,
        )
        if self._classifier is not None:
            self._classifier.step()

    def _count_idle(self) -> None:
        count_low_weight(
            self._renderer.weights,
            ranks=self._renderer.ranks,
            least_weight=self._config.prune_weight,
            low_weight_counts=self._map.fields["low_weight_counts"],
            device=self._device,
        )

    def _step_pose(self, keyframe: Keyframe) -> None:
        step_pose(
            self._renderer.d_pose,
            rates=self._config.pose_rates,
            moments=keyframe.pose_moments,
            steps=keyframe.pose_steps,
            T_cw=keyframe.T_cw,
            device=self._device,
        )

    def _prune(self) -> None:
        flags = wp.empty(self._map.count, dtype=int, device=self._device)
        flag_kept(
            self._map.parameters,
            flags=flags,
            min_opacity=self._config.prune_opacity,
            max_scale=self._config.prune_scale,
            low_weight_counts=self._map.fields["low_weight_counts"] if self._config.prune_idle > 0 else None,
            most_low_weight_counts=self._config.prune_idle,
            device=self._device,
        )
        self._map.keep(flags)
        # A refinement goes on for long without settling.
        self._renderer.make_room()


def _loss_weights(config: OptimiserConfig) -> list[float]:
    """Return the weight of each entry of the losses in the total (GG-SLAM eq. 5)."""
    weights = [0.0] * LOSS_COUNT
    weights[L1] = config.colour_weight * (1.0 - config.dssim)
    weights[DSSIM] = config.colour_weight * config.dssim
    weights[DEPTH] = config.depth_weight
    weights[OBJECT] = config.classifier.weight
    weights[OBJECT_3D] = config.classifier.weight_3d
    return weights
