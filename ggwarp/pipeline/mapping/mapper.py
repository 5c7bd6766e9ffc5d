# SPDX-License-Identifier: Apache-2.0
"""Mapping: keyframes enter the map, and iterations fit the map to the keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from ggwarp.geometry.camera import Camera
from ggwarp.map.covisibility import Covisibility
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.objects.mask_supervision import SupervisionConfig
from ggwarp.objects.object_learning import ObjectLearning
from ggwarp.pipeline.mapping.densification import lower_opacities
from ggwarp.pipeline.mapping.depth_completion import DepthCompletion, DepthCompletionConfig
from ggwarp.pipeline.mapping.exposure import estimate_exposure
from ggwarp.pipeline.mapping.keyframe import upload
from ggwarp.pipeline.mapping.keyframe_sampler import KeyframeSampler, RandomSampler, WindowSampler
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig, unconfirmed
from ggwarp.pipeline.mapping.optimiser import MapOptimiser, OptimiserConfig
from ggwarp.pipeline.mapping.seeding import SeedingConfig, seed_density, seed_gaussians
from ggwarp.runtime.streams import to_host
from ggwarp.types import Exposure, Float64, Frame, Rendered


@dataclass(frozen=True)
class MapperConfig(OptimiserConfig):
    """How the map is built and fitted."""

    iterations: int = 10
    """Mapping iterations a frame (synchronous mode)."""
    bootstrap: int = 0
    """More iterations on the first keyframe, for trackers that look at the map it makes."""
    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    depth_completion: DepthCompletionConfig = field(default_factory=DepthCompletionConfig)
    supervision: SupervisionConfig = field(default_factory=SupervisionConfig)
    seed: int = 0
    """Of the random choice of keyframes and identities."""


class Mapper:
    """The map's only writer.

    Attributes:
        map: the Gaussians.
        objects: which Gaussian is of which object; None without identities.
        covisibility: what a pose sees of the map; None without a window.
        keyframe_indices: frames that were ever used for mapping.
    """

    def __init__(
        self,
        config: MapperConfig,
        camera: Camera,
        gaussians: GaussianMap,
        *,
        objects: ObjectLearning | None = None,
        window: WindowConfig | None = None,
        monocular: bool = False,
        recorded: bool | None = None,
    ) -> None:
        """Prepare to map.

        Args:
            camera: of the keyframes' images.
            gaussians: the map to write, empty.
            objects: learns its objects; None: it has no identities.
            window: fit the keyframes of a covisible window together; None: draw from all.
            monocular: frames have no depth, or an estimate: it seeds the map, but does not bind it.
            recorded: record iterations as graphs and replay them; the default does on CUDA alone: on the CPU
                a recording runs on one thread. The map is the same to the bit.
        """
        self._config = config
        self._camera = camera
        self._device = gaussians.device
        # Two streams: identities must not change which keyframes are drawn.
        self._rng = np.random.default_rng(config.seed)
        self._identity_rng = np.random.default_rng((config.seed, 3))
        self.map = gaussians
        self.objects = objects
        self._renderer = Renderer(self.map, camera, identity_shapes=config.classifier.shapes)
        self.covisibility = None if window is None else Covisibility(self.map, camera)
        self._depth_completion = DepthCompletion(config.depth_completion, camera) if monocular else None
        self._sampler = self._make_sampler(window)
        classifier = None if objects is None else objects.classifier
        self._optimiser = MapOptimiser(
            config, self.map, self._renderer, classifier, self._sampler, recorded=recorded
        )

    @property
    def ready(self) -> bool:
        """Whether there is anything to fit."""
        return bool(self._optimiser.keyframes) and self.map.count > 0

    @property
    def keyframe_indices(self) -> list[int]:
        return [keyframe.index for keyframe in self._optimiser.keyframes]

    def insert(self, frame: Frame, T_wc: Float64, exposure: Exposure | None = None) -> None:
        """Make ``frame`` a keyframe and add the Gaussians that it shows and the map lacks.

        Args:
            T_wc: [4, 4] its pose.
            exposure: of its picture as tracking found it, if it did.
        """
        rendered = self.render(T_wc) if self.map.count else None
        if self._depth_completion is not None and frame.depth is None:
            assert rendered is not None
            frame = replace(frame, depth=self._depth_completion.guess(frame, T_wc, rendered))
        assert frame.depth is not None
        exposure = self._exposure(frame, rendered, exposure)
        seeds = training = None
        if self.objects is not None:
            seeds, training = self.objects.supervise_keyframe(frame, T_wc, rendered)
        density = seed_density(frame, rendered, self._config.seeding, exposure)
        batch = seed_gaussians(
            frame,
            T_wc,
            self._camera,
            density,
            self._config.seeding,
            identities=seeds,
            rng=self._identity_rng,
            exposure=exposure,
            keyframe_id=len(self._optimiser.keyframes),
        )
        self.map.append(batch)
        if self._depth_completion is not None:
            frame = replace(frame, depth=None)
        self._optimiser.add(upload(frame, T_wc, training, exposure, device=self._device))
        self._confirm()

    def _confirm(self) -> None:
        """Remove what too few keyframes of a full window see."""
        drawing, look = self._sampler, None if self.covisibility is None else self.covisibility.look
        if look is None or not isinstance(drawing, WindowSampler) or not drawing.full:
            return
        confirmations = drawing.config.confirmations
        if confirmations == 0:
            return
        sights = {number: look(self.keyframe_pose(number)).seen for number in drawing.window}
        keyframe_ids = to_host(self.map.fields["keyframe_ids"])[: self.map.count]
        kept = ~unconfirmed(keyframe_ids, sights, confirmations)
        self.map.keep(wp.array(kept.astype(np.int32), dtype=int, device=self._device))

    def observe_frame(self, frame: Frame, T_wc: Float64, *, skip_objects: bool = False) -> None:
        """Take in any frame, a keyframe or not, tracked at ``T_wc`` [4, 4]; every one, in order.

        It is kept for the depth of later ones, and its mask may vote.

        Args:
            skip_objects: leave objects as they are, as there is no time.
        """
        if self._depth_completion is not None:
            self._depth_completion.remember(frame, T_wc)
        if skip_objects or self.objects is None or not self.ready:
            return
        keyframes = self._optimiser.keyframes
        if self.objects.vote_is_due(frame, newest=keyframes[-1].index):
            self.objects.vote(frame, T_wc, self.render(T_wc))
        number = self.objects.keyframe_to_relabel(len(keyframes))
        if number is not None:
            keyframe, T_wc = keyframes[number], self._optimiser.pose(number)
            view, depth = self.render(T_wc), to_host(keyframe.depth)
            labels = self.objects.relabel(keyframe.index, depth, T_wc, view)
            if labels is not None and keyframe.labels is not None:
                keyframe.labels.assign(labels)

    def iterate(self) -> None:
        """Fit the map to one keyframe once; on CUDA, queue it: the host reads nothing."""
        self._optimiser.iterate()
        c = self._config.densify
        if c.reset_interval > 0 and self._optimiser.iterations % c.reset_interval == 0:
            self._lower_opacities(c.reset_opacity)

    def _lower_opacities(self, opacity: float) -> None:
        """Lower those of the Gaussians that the window, or without one the newest keyframe, does not see."""
        newest = len(self._optimiser.keyframes) - 1
        window = self._sampler.window if isinstance(self._sampler, WindowSampler) else [newest]
        sees = self.covisibility or Covisibility(self.map, self._camera)
        seen = np.any([sees.look(self.keyframe_pose(number)).seen for number in window], axis=0)
        lower_opacities(self.map, seen, opacity)

    def synchronise(self) -> float:
        """Wait for the iterations since the last call; return their mean loss, NaN where there were none."""
        return self._optimiser.synchronise()

    def keyframe_pose(self, number: int) -> Float64:
        """Return the pose T_wc [4, 4] of keyframe ``number`` (-1: the newest) as it is now."""
        return self._optimiser.pose(number)

    def keyframe_poses(self) -> dict[int, Float64]:
        """Return the pose of each keyframe that is fitted, by the frame's index; none where poses stay."""
        if not self.fits_poses:
            return {}
        return {k.index: self._optimiser.pose(number) for number, k in enumerate(self._optimiser.keyframes)}

    def keyframe_exposure(self, number: int) -> Exposure:
        """Return the exposure of keyframe ``number`` (-1: the newest) as it is now."""
        return self._optimiser.exposure(number)

    @property
    def fits_poses(self) -> bool:
        """Whether keyframes' poses are fitted with the map."""
        return any(self._config.pose_rates)

    def render(self, T_wc: Float64) -> Rendered:
        """Return the map's view from ``T_wc`` [4, 4]."""
        r = self._renderer
        r.render(T_wc)
        image = r.plane(r.image)
        rendered = Rendered(
            rgb=np.ascontiguousarray(np.clip(image[:3], 0.0, 1.0).transpose(1, 2, 0)),
            depth=image[3],
            median_depth=r.plane(r.median_depth),
            opacity=np.float32(1.0) - r.plane(r.transmittance),
        )
        if self.objects is None:
            return rendered
        identity = np.ascontiguousarray(image[4:].transpose(1, 2, 0))
        return self.objects.add_to_render(rendered, r.image, identity)

    def export(self) -> Gaussians:
        """Return the map on the host, each Gaussian with its object's id as the masks name it."""
        return replace(
            self.map.to_host(), object_ids=None if self.objects is None else self.objects.object_ids()[0]
        )

    def _exposure(self, frame: Frame, rendered: Rendered | None, tracked: Exposure | None) -> Exposure:
        """Return where the exposure of a new keyframe starts; the first one has the map's own."""
        if rendered is None or not self._optimiser.keyframes or self._config.exposure_rate <= 0.0:
            return Exposure()
        return tracked or estimate_exposure(frame, rendered, self.keyframe_exposure(-1))

    def _make_sampler(self, window: WindowConfig | None) -> KeyframeSampler:
        if window is None:
            return RandomSampler(self._rng)
        assert self.covisibility is not None
        return WindowSampler(self._rng, window, self.covisibility.look, self.keyframe_pose)
