# SPDX-License-Identifier: Apache-2.0
"""Mapping: keyframes enter the map, and iterations fit the map to the keyframes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.io.ply import PlyGaussians
from ggwarp.kernels.adam import AdamRates, adam_gaussians
from ggwarp.kernels.compact import flag_kept
from ggwarp.kernels.graph import GraphCache
from ggwarp.kernels.loss import DEPTH, DSSIM, L1, LOSS_COUNT, OBJECT, OBJECT_3D, add_total, rgbd_loss
from ggwarp.kernels.math import vec16
from ggwarp.kernels.streams import Backlog, to_host
from ggwarp.map.gaussians import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.map.workspaces import allocate_loss
from ggwarp.objects.classifier import Classifier, ClassifierConfig
from ggwarp.objects.inventory import ObjectRecord, inventory
from ggwarp.objects.linear import LinearClassifier
from ggwarp.objects.registry import NO_OBJECT, ClassTable
from ggwarp.objects.sightings import Sightings
from ggwarp.pipeline.seeding import SeedingConfig, seed_density, seed_gaussians
from ggwarp.pipeline.views import Keyframe, Stage
from ggwarp.types import Camera, Float32, Float64, Frame, Rendered

_RATES = AdamRates(means=2e-4, quats=5e-3, log_scales=1e-2, opacity=0.1, colours=5e-3, identities=2.5e-3)


@dataclass(frozen=True)
class MapperConfig:
    """How the map is built and fitted."""

    iterations: int = 10
    """Mapping iterations a frame (synchronous mode)."""
    colour_weight: float = 1.0
    """l_rgb of the loss (GG-SLAM eq. 5)."""
    dssim: float = 0.2
    """Share of 1 - SSIM in the colour loss (eq. 6)."""
    depth_weight: float = 4.0
    """l_d of the loss; the paper's 0.1 leaves surfaces free to drift along the view for colour's sake."""
    depth_max: float = 10.0
    """Depth unit of eq. 7, metres."""
    rates: AdamRates = _RATES
    """Adam's learning rates: larger than GS-ICP-SLAM's, as each Gaussian gets tens of steps here, not
    thousands."""
    prune_interval: int = 200
    """Prune every so many iterations."""
    prune_opacity: float = 0.005
    """Gaussians less opaque than this are pruned."""
    prune_scale: float = 0.25
    """Gaussians with a larger standard deviation than this are pruned, metres."""
    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    classifier: ClassifierConfig = field(default_factory=ClassifierConfig)
    object_probability: float = 0.3
    """A Gaussian belongs to its likeliest object when that is likelier than this (Gaussian Grouping)."""
    seed: int = 0
    """Of the random choice of keyframes and identities."""


class Mapper:
    """The map's only writer.

    Attributes:
        map: the Gaussians.
        classes: the masks' ids as classes.
        classifier: identity -> class; None without identities.
        sightings: which keyframes showed which object.
        keyframe_indices: frames that were ever used for mapping.
    """

    def __init__(
        self,
        config: MapperConfig,
        camera: Camera,
        *,
        device: Any,
        use_identity: bool,
        recorded: bool | None = None,
    ) -> None:
        """Build an empty map.

        Args:
            camera: of the keyframes' images.
            recorded: record iterations as graphs and replay them; the default does on CUDA alone: on the CPU
                a recording runs on one thread. The map is the same to the bit.
        """
        self._config = config
        self._camera = camera
        self._device = wp.get_device(device)
        self._rng = np.random.default_rng(config.seed)
        self.map = GaussianMap(device=device, has_identity=use_identity)
        self.classes = ClassTable()
        self.classifier = Classifier(config.classifier, self.map, seed=config.seed) if use_identity else None
        self.sightings = Sightings()
        self._renderer = Renderer(self.map, camera)
        self._workspace = allocate_loss(camera.height, camera.width, device=self._device)
        self._losses = wp.zeros(LOSS_COUNT, dtype=float, device=self._device)
        self._loss_weights = wp.array(_loss_weights(config), dtype=float, device=self._device)
        self._totals = wp.zeros(2, dtype=wp.float64, device=self._device)
        self._backlog = Backlog(self._device)
        self._recorded = self._device.is_cuda if recorded is None else recorded
        self._graphs, self._stage = GraphCache(self._device), Stage()
        self._rates = wp.array(config.rates.lanes(), dtype=vec16, device=self._device)
        self._keyframes: list[Keyframe] = []
        self._newest_pending = False
        self._iterations = 0

    @property
    def ready(self) -> bool:
        """Whether there is anything to fit."""
        return bool(self._keyframes) and self.map.count > 0

    @property
    def keyframe_indices(self) -> list[int]:
        return [keyframe.index for keyframe in self._keyframes]

    def insert(self, frame: Frame, T_wc: Float64) -> None:
        """Make ``frame`` a keyframe and add the Gaussians that it shows and the map lacks."""
        assert frame.depth is not None
        classes = None
        if self.classifier is not None and frame.mask is not None:
            classes = self.classes.encode(frame.mask)
            self.classifier.grow(self.classes.count)
            self.sightings.add(frame.index, frame.mask)
        rendered = self.render(T_wc) if self.map.count else None
        density = seed_density(frame, rendered, self._config.seeding)
        batch = seed_gaussians(
            frame,
            T_wc,
            self._camera,
            density,
            self._config.seeding,
            codes=None if self.classifier is None else self.classifier.codes,
            classes=classes,
            rng=self._rng,
        )
        self.map.append(batch)
        self._keyframes.append(self._upload(frame, T_wc, classes))
        self._newest_pending = True
        if self._recorded:
            self._renderer.provide(self._keyframes[-1].T_cw)

    def iterate(self) -> None:
        """Fit the map to one keyframe once; on CUDA, queue it: the host reads nothing."""
        keyframe = self._draw()
        with_3d = self.classifier is not None and self.classifier.begin_3d(self._iterations)
        if self._recorded:
            staged = self._stage.load(keyframe)
            variant = (staged.labels is not None, with_3d)
            self._graphs.run(variant, lambda: self._fit(staged, with_3d), arrays=self._allocation)
        else:
            self._fit(keyframe, with_3d)
        self._backlog.added()
        self._iterations += 1
        if self._iterations % self._config.prune_interval == 0:
            self._prune()

    def settle(self) -> float:
        """Wait for the iterations since the last call; return their mean loss, NaN where there were none."""
        total, count = to_host(self._totals).tolist()
        self._totals.zero_()
        self._renderer.make_room()
        return total / count if count else math.nan

    def render(self, T_wc: Float64) -> Rendered:
        """Return the map's view from ``T_wc`` [4, 4]."""
        r = self._renderer
        pose = r.pose_array(T_wc)
        r.forward(pose)
        if r.make_room():
            r.forward(pose)
        image = r.plane(r.image)
        identity = objects = None
        opacity = np.float32(1.0) - r.plane(r.transmittance)
        if self.classifier is not None:
            identity = np.ascontiguousarray(image[4:].transpose(1, 2, 0))
            classes = self.classifier.classify_image(r.image, self._camera.height, self._camera.width)
            objects = np.where(opacity > 0.5, self.classes.decode(classes), 0).astype(np.int32)
        return Rendered(
            rgb=np.ascontiguousarray(np.clip(image[:3], 0.0, 1.0).transpose(1, 2, 0)),
            depth=image[3],
            median_depth=r.plane(r.median_depth),
            opacity=opacity,
            identity=identity,
            objects=objects,
        )

    def export(self) -> PlyGaussians:
        """Return the map on the host, each Gaussian with its object's id as the masks name it."""
        return PlyGaussians(object_ids=self._belongings()[0], **self.map.to_host())

    def objects(self, names: dict[int, str]) -> list[ObjectRecord]:
        """Describe the map's objects; ``names`` are their classes by id, where known."""
        object_ids, probabilities = self._belongings()
        arrays = self.map.to_host()
        return inventory(
            arrays["means"],
            arrays["colours"],
            object_ids,
            names=names,
            sightings=self.sightings,
            probabilities=probabilities,
        )

    def linear_classifier(self) -> LinearClassifier | None:
        """Return the identity classifier on the host; None without identities."""
        if self.classifier is None:
            return None
        weights, biases = self.classifier.to_host()
        return LinearClassifier(weights, biases, self.classes.ids[: self.classifier.count])

    def _belongings(self) -> tuple[NDArray[np.int32] | None, Float32 | None]:
        """Return [n] the object of each Gaussian, and [n] how probable that is."""
        if self.classifier is None:
            return None, None
        classes, probabilities = self.classifier.classify_map()
        sure = probabilities > self._config.object_probability
        return np.where(sure, self.classes.decode(classes), NO_OBJECT).astype(np.int32), probabilities

    def _draw(self) -> Keyframe:
        """The newest keyframe first, once; then any, at random."""
        if self._newest_pending:
            self._newest_pending = False
            return self._keyframes[-1]
        return self._keyframes[self._rng.integers(len(self._keyframes))]

    @property
    def _allocation(self) -> tuple[int, ...]:
        """Changes when a recorded iteration no longer holds."""
        classes = self.classifier.count if self.classifier is not None else 0
        return (self.map.allocation, self._renderer.allocation, classes)

    def _fit(self, keyframe: Keyframe, with_3d: bool) -> None:
        """One iteration: render, compare, take the gradient back, step. It only launches: it is recorded."""
        self._renderer.forward(keyframe.T_cw)
        self._evaluate(keyframe)
        self._renderer.adjoint(keyframe.T_cw)
        if self.classifier is not None and with_3d:
            self.classifier.evaluate_3d(self._renderer, self._losses)
        self._step()
        add_total(self._losses, weights=self._loss_weights, totals=self._totals, device=self._device)

    def _evaluate(self, keyframe: Keyframe) -> None:
        """Write the loss and its gradient by the image (GG-SLAM eq. 5)."""
        c = self._config
        rgbd_loss(
            self._renderer.image,
            keyframe.colour,
            keyframe.depth,
            d_image=self._renderer.d_image,
            losses=self._losses,
            workspace=self._workspace,
            colour_weight=c.colour_weight,
            dssim=c.dssim,
            depth_weight=c.depth_weight,
            d_max=c.depth_max,
            device=self._device,
        )
        if self.classifier is not None:
            self.classifier.evaluate(self._renderer, keyframe.labels, self._losses)

    def _step(self) -> None:
        adam_gaussians(
            self.map.parameters,
            self._renderer.gradients,
            self.map.adam_state,
            rates=self._rates,
            ranks=self._renderer.ranks,
            device=self._device,
        )
        if self.classifier is not None:
            self.classifier.step()

    def _prune(self) -> None:
        flags = wp.empty(self.map.count, dtype=int, device=self._device)
        flag_kept(
            self.map.parameters,
            flags=flags,
            min_opacity=self._config.prune_opacity,
            max_scale=self._config.prune_scale,
            device=self._device,
        )
        self.map.keep(flags)
        # A refinement goes on for long without settling.
        self._renderer.make_room()

    def _upload(self, frame: Frame, T_wc: Float64, classes: Any) -> Keyframe:
        return Keyframe(
            index=frame.index,
            T_cw=self._renderer.pose_array(T_wc),
            colour=wp.array(frame.rgb, dtype=wp.uint8, device=self._device),
            depth=wp.array(frame.depth, dtype=float, device=self._device),
            labels=None if classes is None else wp.array(classes, dtype=int, device=self._device),
        )


def _loss_weights(config: MapperConfig) -> list[float]:
    """Return the weight of each entry of the losses in the total (GG-SLAM eq. 5)."""
    weights = [0.0] * LOSS_COUNT
    weights[L1] = config.colour_weight * (1.0 - config.dssim)
    weights[DSSIM] = config.colour_weight * config.dssim
    weights[DEPTH] = config.depth_weight
    weights[OBJECT] = config.classifier.weight
    weights[OBJECT_3D] = config.classifier.weight_3d
    return weights
