# SPDX-License-Identifier: Apache-2.0
"""Fitting the map to its keyframes: one view an iteration, Adam on what it shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from ggwarp.kernels.losses.isotropy import pull_round
from ggwarp.kernels.losses.rgbd import LOSS_COUNT, OBJECT, OBJECT_3D, add_total
from ggwarp.kernels.optim.adam import AdamRates
from ggwarp.kernels.optim.compact import count_low_weight, flag_kept
from ggwarp.kernels.optim.pose_adam import step_pose
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussian_optimiser import GaussianOptimiser
from ggwarp.map.renderer import Renderer
from ggwarp.map.submaps import Submaps
from ggwarp.objects.classifier import Classifier, ClassifierConfig
from ggwarp.pipeline.mapping.densification import DensifyConfig, densify_gaussians, densify_is_due
from ggwarp.pipeline.mapping.exposure import ExposureModel
from ggwarp.pipeline.mapping.keyframe import EXPOSURE, POSE, Keyframe, KeyframeBuffer, Keyframes
from ggwarp.pipeline.mapping.keyframe_sampler import KeyframeSampler
from ggwarp.runtime.graphs import GraphCache
from ggwarp.runtime.state import Stateful
from ggwarp.runtime.streams import Backlog, to_host

RATES = AdamRates(means=2e-4, quats=2e-2, log_scales=2.5e-2, opacity=0.2, colours=1e-2, identities=2.5e-2)
"""Adam's: larger than GS-ICP-SLAM's, as each Gaussian gets tens of steps here, not thousands."""
MONOCULAR_RATES = replace(RATES, means=3e-4)
"""Gaussians of guessed depth have farther to go."""
_PRUNE_INTERVAL = 200
"""Iterations from one pruning to the next."""
_PRUNE_OPACITY = 0.005
"""Gaussians less opaque than this are pruned."""
_PRUNE_SCALE = 0.25
"""Gaussians with a larger standard deviation than this are pruned, metres."""
_LOW_WEIGHT = 0.05
"""A Gaussian that makes up fewer pixels of a view than this has a low weight there."""


@dataclass(frozen=True)
class OptimiserConfig:
    """What the map is fitted to, and how fast."""

    depth_weight: float = 4.0
    """Weight of the depth error in the loss (l_d of GG-SLAM eq. 5). The paper's 0.1 leaves surfaces free to
    drift along the view for colour's sake."""
    isotropic_weight: float = 0.0
    """Pull towards round Gaussians: a Gaussian adds this to the loss for every metre that its axes differ,
    times its share of a pixel (MonoGS eq. 10 has 10, by each Gaussian's share). It is not in the reported
    loss."""
    rate_decay: float = 100.0
    """A Gaussian's learning rates fall by 1 / sqrt(1 + t / rate_decay) over its steps t, so that it settles
    between views that disagree a little, as a real camera's do. With 0 they stay, as they must where poses
    still move."""
    pose_rates: tuple[float, float] = (0.0, 0.0)
    """Adam's learning rates of the keyframes' poses, metres and radians. With 0 poses stay as tracked."""
    exposure_rate: float = 0.0
    """Adam's learning rate of the keyframes' exposures. With 0 pictures are taken as they are."""
    prune_low_weight: int = 20
    """A Gaussian is pruned, as it is hidden, when it makes up next to nothing of that many views in a row
    that could show it. With 0 it stays."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    classifier: ClassifierConfig = field(default_factory=ClassifierConfig)


class MapOptimiser(Stateful):
    """Fits a map to keyframes; the map's writer calls it.

    Attributes:
        iterations: so far.
    """

    STATE = ("iterations", "_gaussians", "_totals")

    def __init__(
        self,
        config: OptimiserConfig,
        gaussians: GaussianMap,
        renderer: Renderer,
        classifier: Classifier | None,
        keyframes: Keyframes,
        sampler: KeyframeSampler,
        submaps: Submaps,
        *,
        exposures: ExposureModel | None = None,
        rates: AdamRates = RATES,
        recorded: bool | None = None,
    ) -> None:
        """Prepare to fit ``gaussians`` to keyframes of the renderer's camera.

        Args:
            keyframes: what to fit to; :meth:`add` adds to them.
            sampler: which keyframe an iteration is spent on.
            submaps: tells whether all of the map is on the device.
            exposures: fits the keyframes' exposures; None: they stay.
            rates: Adam's learning rates of the Gaussians.
            recorded: record iterations as graphs and replay them; the default does on CUDA alone: on the CPU
                a recording runs on one thread. The map is the same to the bit.
        """
        self._config = config
        self._map = gaussians
        self._device = gaussians.device
        self._renderer = renderer
        self._classifier = classifier
        self._keyframes = keyframes
        self._sampler = sampler
        self._submaps = submaps
        self._gaussians = GaussianOptimiser(
            gaussians,
            renderer,
            rates=rates,
            depth_weight=config.depth_weight,
            rate_decay=config.rate_decay,
        )
        self._exposures = exposures
        weights = self._gaussians.loss_weights | {
            OBJECT: config.classifier.weight,
            OBJECT_3D: config.classifier.weight_3d,
        }
        self._loss_weights = wp.array(
            [weights.get(entry, 0.0) for entry in range(LOSS_COUNT)], dtype=float, device=self._device
        )
        self._totals = wp.zeros(2, dtype=wp.float64, device=self._device)
        self._backlog = Backlog(self._device)
        self._recorded = self._device.is_cuda if recorded is None else recorded
        self._graphs, self._buffer = GraphCache(self._device), KeyframeBuffer()
        self.iterations = 0

    def add(self, keyframe: Keyframe) -> None:
        """Fit the map to ``keyframe``, too."""
        self._keyframes.append(keyframe)
        (self._sampler.add_earlier if keyframe.is_earlier else self._sampler.add)()
        if self._recorded:
            self._renderer.provide(keyframe.T_cw)

    def iterate(self) -> None:
        """Fit the map to one keyframe once; on CUDA, queue it: the host reads nothing.

        Where that is out of memory it is put off, and comes with others later.
        """
        for number in self._sampler.next():
            self._iterate(number)

    def catch_up(self) -> None:
        """Fit the map to all that is still put off."""
        while numbers := self._sampler.put_off():
            for number in numbers:
                self._iterate(number)

    def _iterate(self, number: int) -> None:
        if self._submaps.parked:
            # Views then come submap by submap: many in a row look past what the next ones show.
            self._map.fields["low_weight_counts"].zero_()
        keyframe = self._keyframes[number]
        with_3d = self._classifier is not None and self._classifier.begin_3d(self.iterations)
        # The first keyframe holds the world in place, and its brightness, or an earlier map does.
        free = number > 0 and not keyframe.is_earlier
        with_pose = free and any(self._config.pose_rates)
        with_exposure = free and self._exposures is not None
        change = (POSE if with_pose else ()) + (EXPOSURE if with_exposure else ())
        if self._recorded:
            buffered = self._buffer.load(keyframe)
            given = buffered.labels is not None, buffered.depth_weights is not None
            variant = (buffered.has_depth, *given, with_3d, change)
            self._graphs.run(variant, lambda: self._fit(buffered, with_3d, change), arrays=self._allocation)
            self._buffer.store(keyframe, change)
        else:
            self._fit(keyframe, with_3d, change)
        self._backlog.added()
        self.iterations += 1
        if self.iterations % _PRUNE_INTERVAL == 0:
            self._prune()
        densify = self._config.densify
        if densify_is_due(densify, self.iterations):
            rng = np.random.default_rng((5, self.iterations))
            densify_gaussians(self._map, rng, threshold=densify.threshold)
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
        self._compare(keyframe, with_exposure="exposure" in change)
        self._renderer.adjoint(
            keyframe.T_cw, pose=with_pose, mean2d_gradient_norms=self._config.densify.interval > 0
        )
        if self._classifier is not None and with_3d:
            self._classifier.evaluate_3d(self._renderer, self._gaussians.losses)
        if self._config.isotropic_weight > 0.0:
            self._pull_round()
        if self._config.prune_low_weight > 0:
            self._count_low_weight()
        self._gaussians.update()
        if self._classifier is not None:
            self._classifier.step()
        if with_pose:
            self._step_pose(keyframe)
        add_total(
            self._gaussians.losses, weights=self._loss_weights, totals=self._totals, device=self._device
        )

    def _compare(self, keyframe: Keyframe, *, with_exposure: bool) -> None:
        """Write the losses and their gradient by the render, and step the keyframe's exposure."""
        exposures = self._exposures if with_exposure else None
        if exposures is not None:
            exposures.show(keyframe)
        self._gaussians.compare(keyframe, self._renderer.image if exposures is None else exposures.image)
        if self._classifier is not None:
            self._classifier.evaluate(self._renderer, keyframe.labels, self._gaussians.losses)
        if exposures is not None:
            exposures.step(keyframe)

    def _pull_round(self) -> None:
        camera, rows = self._renderer.camera, self._renderer.rows
        pull_round(
            self._map.parameters.log_scales,
            ranks=self._renderer.ranks,
            weight=self._config.isotropic_weight / (camera.width * camera.height),
            d_log_scales=self._renderer.gradients.log_scales[:rows],
            device=self._device,
        )

    def _count_low_weight(self) -> None:
        count_low_weight(
            self._renderer.weights,
            ranks=self._renderer.ranks,
            least_weight=_LOW_WEIGHT,
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
        most = self._config.prune_low_weight
        flag_kept(
            self._map.parameters,
            flags=flags,
            min_opacity=_PRUNE_OPACITY,
            max_scale=_PRUNE_SCALE,
            low_weight_counts=self._map.fields["low_weight_counts"] if most > 0 else None,
            most_low_weight_counts=most,
            device=self._device,
        )
        self._map.keep(flags)
        # A refinement goes on for long without waiting for the device.
        self._renderer.make_room()
