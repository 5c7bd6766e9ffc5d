# SPDX-License-Identifier: Apache-2.0
"""Mapping: keyframes enter the map, and iterations fit the map to the keyframes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.map.covisibility import Covisibility
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer
from ggwarp.map.submaps import Submaps
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.objects.masks.mask_supervision import SupervisionConfig
from ggwarp.objects.object_learning import ObjectLearning
from ggwarp.pipeline.mapping.contradictions import Contradictions
from ggwarp.pipeline.mapping.densification import RESET_OPACITY, lower_opacities
from ggwarp.pipeline.mapping.depth_completion import DepthCompletion
from ggwarp.pipeline.mapping.exposure import ExposureModel
from ggwarp.pipeline.mapping.keyframe import Keyframes, upload
from ggwarp.pipeline.mapping.keyframe_sampler import KeyframeSampler
from ggwarp.pipeline.mapping.optimiser import MapOptimiser, OptimiserConfig
from ggwarp.pipeline.mapping.passed_over import PassedOver
from ggwarp.pipeline.mapping.seeding import Seeder, SeedingConfig, Seen
from ggwarp.pipeline.moving_pixels import without_pixels
from ggwarp.runtime.state import Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.types import Exposure, Float64, Frame, Rendered


@dataclass(frozen=True)
class MapperConfig(OptimiserConfig):
    """How the map is built and fitted."""

    iterations: int = 10
    """Mapping iterations for every frame (synchronous mode)."""
    bootstrap: int = 0
    """The first keyframe gets that many iterations more, for trackers that look at the map it makes."""
    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    supervision: SupervisionConfig = field(default_factory=SupervisionConfig)
    seed: int = 0
    """Seed of the random choice of keyframes and identities."""


class Mapper(Stateful):
    """The map's only writer; :func:`ggwarp.pipeline.mapping.build.build_mapper` puts its parts together.

    Attributes:
        map: the Gaussians.
        objects: which Gaussian is of which object; None without identities.
        covisibility: what a pose sees of the map; None without a window.
        submaps: the whole map, of which that is what is on the device.
        refused: whether the last picture was left out, and the next frame may take its place.
    """

    STATE = (
        "map",
        "objects",
        "_renderer",
        "_keyframes",
        "_sampler",
        "_optimiser",
        "_depth_completion",
        "_identity_rng",
        "submaps",
        "_contradictions",
        "refused",
        "_passed_over",
    )

    def __init__(
        self,
        config: MapperConfig,
        gaussians: GaussianMap,
        renderer: Renderer,
        keyframes: Keyframes,
        sampler: KeyframeSampler,
        optimiser: MapOptimiser,
        submaps: Submaps,
        *,
        objects: ObjectLearning | None = None,
        covisibility: Covisibility | None = None,
        exposures: ExposureModel | None = None,
        depth_completion: DepthCompletion | None = None,
    ) -> None:
        """Prepare to map.

        Args:
            gaussians: the map to write, empty.
            renderer: shows it to the keyframes' camera.
            keyframes: none yet; ``sampler`` and ``optimiser`` work on these.
            submaps: keeps what of the map is in view on the device.
            objects: learns the map's objects; None: it has no identities.
            covisibility: what a pose sees of the map, where keyframes are fitted in a window.
            exposures: the model of the keyframes' exposures; None: pictures are taken as they are.
            depth_completion: frames have no depth, or an estimate: it seeds the map, but does not bind it.
        """
        self._config = config
        self._device = gaussians.device
        # A stream of its own: identities must not change which keyframes are drawn.
        self._identity_rng = np.random.default_rng((config.seed, 3))
        self.map = gaussians
        self._renderer = renderer
        self._keyframes = keyframes
        self._sampler = sampler
        self._optimiser = optimiser
        self.submaps = submaps
        self.objects = objects
        self.covisibility = covisibility
        self._exposures = exposures
        self._depth_completion = depth_completion
        self._seeder = Seeder(config.seeding, renderer.camera, gaussians, flat=depth_completion is None)
        self._contradictions = Contradictions(gaussians, keyframes, renderer.camera, submaps)
        self.refused = False
        self._passed_over = PassedOver()

    @property
    def ready(self) -> bool:
        """Whether there is anything to fit: not an earlier map alone."""
        return len(self._keyframes) > 0 and not self._keyframes.origins[-1].is_earlier and self.map.count > 0

    @property
    def keyframe_indices(self) -> list[int]:
        """Frames that were ever used for mapping."""
        return [origin.index for origin in self._keyframes.origins if not origin.is_earlier]

    @property
    def left_out(self) -> dict[str, int]:
        """See :class:`ggwarp.pipeline.mapping.contradictions.Contradictions`."""
        return self._contradictions.left_out

    def rehearse(self, view: Frame, T_wc: Float64, rendered: Rendered) -> None:
        """Fit an earlier map to its own ``view`` from ``T_wc`` [4, 4], too: what is not seen again stays."""
        labels = None if self.objects is None else self.objects.labels_of(rendered)
        self.submaps.add(T_wc, view.depth)
        self._optimiser.add(upload(view, T_wc, labels, device=self._device))
        self._contradictions.add_earlier(view, T_wc)

    def insert(self, frame: Frame, T_wc: Float64, exposure: Exposure | None = None) -> bool:
        """Make ``frame`` a keyframe and add the Gaussians that it shows and the map lacks.

        What of it contradicts the map or the keyframes before it is left out, and what it contradicts of
        those; a picture that is of no use is left out whole. The last frame before it that is of use, and no
        keyframe yet, then becomes one: what was seen by then may not be seen again.

        Args:
            T_wc: [4, 4] its pose.
            exposure: of its picture as tracking found it, if it did.

        Returns:
            Whether it became one.
        """
        self.refused = not self._insert(frame, T_wc, exposure)
        while self.refused and self._passed_over and not self._insert(*self._passed_over.pop()):
            pass
        self._passed_over.clear()
        return not self.refused

    def _insert(self, frame: Frame, T_wc: Float64, exposure: Exposure | None = None) -> bool:
        self.submaps.show(T_wc, frame.depth)
        if seen := self.map.count > 0:
            self._renderer.render(T_wc)
        measured, wrong = frame, None  # what is contradicted stays in the picture, but does not count
        if self._depth_completion is None:  # depth that is an estimate proves nothing
            wrong = self._contradictions.find(frame, T_wc, self._renderer if seen else None)
            if wrong is None:
                return False
            frame = without_pixels(frame, wrong)
        estimating = self._depth_completion is not None or self._exposures is not None
        rendered = self._renderer.picture() if seen and estimating else None
        if self._depth_completion is not None:
            frame = self._depth_completion.complete(frame, T_wc, rendered)
            measured = replace(frame, depth=None)
        if self._exposures is None:
            exposure = Exposure()
        else:
            exposure = self._exposures.begin(frame, rendered, self._keyframes, exposure)
        seeds = training = None
        if self.objects is not None:
            whole = frame if wrong is None else measured
            seeds, training = self.objects.supervise_keyframe(
                whole,
                T_wc,
                self._renderer if seen else None,
                without=wrong if wrong is not None and wrong.any() else None,
            )
        keyframe = upload(measured, T_wc, training, exposure, device=self._device)
        depth = keyframe.depth
        if frame.depth is not measured.depth:
            depth = wp.array(frame.depth, dtype=float, device=self._device)
        planes = self._renderer.planes if seen else None
        shown = Seen(frame.index, keyframe.colour, depth, T_wc, keyframe.exposure, planes)
        self.submaps.add(T_wc, frame.depth, bounded=self._depth_completion is None)
        self._seeder.seed(shown, len(self._keyframes), seeds, self._identity_rng)
        self._optimiser.add(keyframe)
        if wrong is not None:
            self._contradictions.leave_out_of_the_last(wrong)
        self._drop_unconfirmed()
        return True

    def move(self, correction: PoseCorrection) -> None:
        """Let keyframes follow a closed loop, and each Gaussian its keyframe, with Adam's memory of it."""
        motions = correction.at(self._keyframes.indices)
        self._keyframes.move(motions)
        self._contradictions.move(lambda number: motions[number])
        self._passed_over.move(correction)
        if self._depth_completion is not None:
            self._depth_completion.move(correction)
        self.submaps.move(motions)

    def _drop_unconfirmed(self) -> None:
        """Remove the Gaussians that too few keyframes of a full window see."""
        doubtful = self._sampler.unconfirmed(
            lambda: to_host(self.map.fields["keyframe_ids"])[: self.map.count]
        )
        if doubtful is not None:
            self.map.keep(wp.array((~doubtful).astype(np.int32), dtype=int, device=self._device))

    def observe_frame(self, frame: Frame, T_wc: Float64, *, skip_objects: bool = False) -> None:
        """Take in any frame, a keyframe or not, tracked at ``T_wc`` [4, 4]; every one, in order.

        It is kept for the depth of later ones, and its mask may vote.

        Args:
            skip_objects: leave objects as they are, as there is no time.
        """
        if self._depth_completion is not None:
            self._depth_completion.observe(frame, T_wc)
        elif self.ready and not self.refused and frame.index != self._keyframes.origins[-1].index:
            self._passed_over.add(frame, T_wc)
        self.submaps.show(T_wc, frame.depth)
        if skip_objects or self.objects is None or not self.ready:
            return
        if self.objects.vote_is_due(frame, newest=self._keyframes.origins[-1].index):
            self._renderer.render(T_wc)
            self.objects.vote(frame, T_wc, self._renderer)
        hidden = self.submaps.hidden_keyframes()
        numbers = range(len(self._keyframes)) if hidden is None else np.flatnonzero(~hidden).tolist()
        turn = self.objects.keyframe_to_relabel(len(numbers))
        if turn is not None:
            number = numbers[turn]
            index, T_wc = self._keyframes.origins[number].index, self._keyframes.pose(number)
            self._renderer.render(T_wc)
            depth = self._keyframes.depth(number, step=self.objects.grid.step)
            if (labels := self.objects.relabel(index, depth, T_wc, self._renderer)) is not None:
                self._keyframes.label(number, labels)

    def iterate(self) -> None:
        """Fit the map to one keyframe once; on CUDA, queue it: the host reads nothing."""
        before = self._optimiser.iterations
        self._optimiser.iterate()
        interval = self._config.densify.reset_interval
        if interval > 0 and self._optimiser.iterations // interval > before // interval:
            self._reset_opacities()

    def catch_up(self) -> None:
        """Fit the map to what was out of memory when its turn came."""
        self._optimiser.catch_up()
        self._optimiser.synchronise()

    def _reset_opacities(self) -> None:
        """Lower those of the Gaussians that the window, or without one the newest keyframe, does not see."""
        look = (self.covisibility or Covisibility(self.map, self._renderer.camera)).look
        seen = np.any([look(self._keyframes.pose(number)).seen for number in self._sampler.window], axis=0)
        lower_opacities(self.map, seen, RESET_OPACITY)

    def synchronise(self) -> float:
        """Wait for the iterations since the last call; return their mean loss, NaN where there were none."""
        return self._optimiser.synchronise()

    @property
    def fits_poses(self) -> bool:
        """Whether keyframes' poses are fitted with the map."""
        return any(self._config.pose_rates)

    def keyframe_pose(self, number: int) -> Float64:
        """Return the pose T_wc [4, 4] of keyframe ``number`` (-1: the newest) as it is now."""
        return self._keyframes.pose(number)

    def keyframe_poses(self) -> dict[int, Float64]:
        """Return the pose of each keyframe that is fitted, by the frame's index; none where poses stay."""
        return self._keyframes.poses() if self.fits_poses else {}

    def keyframe_exposure(self, number: int) -> Exposure:
        """Return the exposure of keyframe ``number`` (-1: the newest) as it is now."""
        return self._keyframes.exposure(number)

    def render(self, T_wc: Float64) -> Rendered:
        """Return the map's view from ``T_wc`` [4, 4], with all that it shows."""
        self.submaps.show_rendered(T_wc, lambda: self._look(T_wc))
        rendered = self._look(T_wc)
        if self.objects is None:
            return rendered
        rendered = self.objects.add_classes(rendered, self._renderer.image)
        return self.objects.add_objects(rendered, self._renderer.identity())

    def _look(self, T_wc: Float64) -> Rendered:
        """Return the picture from ``T_wc`` [4, 4]; what else it shows stays on the device."""
        self._renderer.render(T_wc)
        return self._renderer.picture()

    def parts(self) -> Iterator[Gaussians]:
        """Yield the map on the host part by part, each Gaussian with its object's id as the masks name it."""
        for part in self.submaps.parts():
            ids = None if self.objects is None else self.objects.object_ids(part)[0]
            yield replace(part.to_host(), object_ids=ids)

    def inventory(self, names: dict[int, str]) -> list[ObjectRecord]:
        """Describe the map's objects; ``names`` are their classes by id, where known."""
        return [] if self.objects is None else self.objects.inventory(names, self.submaps.parts())
