# SPDX-License-Identifier: Apache-2.0
"""Which object each Gaussian of a map is of: all that a mapper needs to learn it and to say it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pixel_grid import PixelGrid
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians, join
from ggwarp.map.renderer import Planes, Renderer
from ggwarp.objects.class_table import IGNORED, NO_OBJECT, ClassTable
from ggwarp.objects.classifier import Classifier, ClassifierConfig, IdentitySeeds
from ggwarp.objects.inventory import ObjectRecord, inventory
from ggwarp.objects.labels import Labels
from ggwarp.objects.linear_classifier import LinearClassifier
from ggwarp.objects.masks.keyframe_labels import KeyframeLabels
from ggwarp.objects.masks.label_grid import LabelPictures, MaskLabels
from ggwarp.objects.masks.mask_supervision import ObjectSupervision, SupervisionConfig
from ggwarp.objects.masks.mask_view import LabelTargets, PosedDepth
from ggwarp.objects.visibility import ObjectVisibility
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32, Float64, Frame, Rendered

_OPAQUE = 0.5  # a pixel shows an object where the map is at least so opaque
_PROBABLE = 0.3  # a Gaussian belongs to its likeliest object when that is likelier (Gaussian Grouping)


class ObjectLearning(Stateful):
    """The objects of a map.

    Attributes:
        classes: the masks' ids as classes.
        classifier: identity -> class.
        grid: the pixels of frames that are looked at.
        visibility: which keyframes showed which class.
        voting_indices: frames whose mask voted, but that were not mapped.
    """

    STATE = (
        "classes",
        "classifier",
        "visibility",
        "voting_indices",
        "_supervision",
        "_keyframe_labels",
        "_other_frames",
        "_told",
        "_frames",
    )

    def __init__(
        self,
        config: SupervisionConfig,
        classifier: ClassifierConfig,
        camera: Camera,
        gaussians: GaussianMap,
        *,
        seed: int,
        tracked_masks: bool = True,
    ) -> None:
        """Prepare to learn the objects of ``gaussians``, which has identities.

        Args:
            camera: of the frames.
            seed: of the random identities.
            tracked_masks: whether the masks' ids mean the same object in every frame.
        """
        self._config = config
        self._map = gaussians
        self.classes = ClassTable()
        self.classifier = Classifier(classifier, gaussians, seed=seed)
        self.visibility = ObjectVisibility()
        self.voting_indices: list[int] = []
        self.grid = PixelGrid.of(camera)
        self._supervision = ObjectSupervision(
            config, self.grid.camera, gaussians, self.classes, self.classifier, tracked=tracked_masks
        )
        self._pictures = LabelPictures(self.grid, device=gaussians.device)
        self._keyframe_labels = KeyframeLabels(self.classes, self._pictures)
        self._other_frames = self._frames = 0
        self._told: dict[int, dict[str, Any]] = {}  # by an earlier map's list of objects

    def adopt(self, gaussians: Gaussians, records: Sequence[ObjectRecord]) -> Gaussians:
        """Begin with an earlier map's objects; return its Gaussians as they enter this map.

        Each object has a class anew, as if many masks had said what the map says.

        Args:
            gaussians: with object ids, if any are known.
            records: its list of objects, for their names.
        """
        count = len(gaussians)
        ids = np.zeros(count, np.int32) if gaussians.object_ids is None else gaussians.object_ids
        self.classes.adopt(np.unique(ids[ids > NO_OBJECT]).tolist())
        self.classifier.grow(self.classes.count)
        classes = np.searchsorted(self.classes.ids, ids).astype(np.int32)
        self._supervision.adopt(gaussians.means, classes)
        names = ("class_name", "label", "source_ids")
        self._told = {r.id: {name: getattr(r, name) for name in names} for r in records}
        votes = np.where(classes > NO_OBJECT, self._config.votes, 0).astype(np.int32)
        return replace(gaussians, identities=self.classifier.codes[classes], votes=votes)

    def labels_of(self, rendered: Rendered) -> Labels:
        """Return [h, w] the class that the map shows where it is sure of it, else negative."""
        assert rendered.classes is not None and rendered.confidence is not None
        sure = (rendered.opacity > _OPAQUE) & (rendered.confidence > _PROBABLE)
        return np.where(sure, rendered.classes, np.int32(IGNORED))

    def supervise_keyframe(
        self,
        frame: Frame,
        T_wc: Float64,
        renderer: Renderer | None,
        *,
        without: NDArray[np.bool_] | None = None,
    ) -> tuple[IdentitySeeds, Any]:
        """Take in a keyframe's mask.

        Args:
            frame: with depth.
            T_wc: [4, 4] its pose.
            renderer: has rendered the map from there; None while the map is empty.
            without: [h, w] pixels that the rendered identity is not to be fitted to; None: there are none.

        Returns:
            What new Gaussians begin as, and [h, w] int on the device: the class that the rendered identity
            should have, negative for any; None: the frame says nothing of objects.
        """
        assert frame.depth is not None
        few = self._supervise(frame, T_wc, renderer, keep=True)
        if few is None:
            return IdentitySeeds(self.classifier.codes), None
        labels = MaskLabels.of(self.grid, few.votes, frame.mask)
        height, width = frame.depth.shape
        votes, training, begun = self._pictures.changed(
            labels, (height, width), few.training, few.seeds, without=without
        )
        self.visibility.add(frame.index, few.votes)
        seeds = IdentitySeeds(self.classifier.codes, begun, votes)
        if frame.mask is None:
            return seeds, None
        self._keyframe_labels.keep(frame.index, labels)
        return seeds, training

    def vote_is_due(self, frame: Frame, newest: int) -> bool:
        """Return whether ``frame`` is to vote though it is no keyframe; ask once for every frame, in order.

        Args:
            newest: index of the newest keyframe.
        """
        c = self._config
        if c.votes == 0 or c.vote_interval == 0 or frame.mask is None or frame.index == newest:
            return False
        self._other_frames += 1
        return self._other_frames % c.vote_interval != 0

    def vote(self, frame: Frame, T_wc: Float64, renderer: Renderer) -> None:
        """Let the mask of a frame vote that is no keyframe; arguments as of :meth:`supervise_keyframe`."""
        self._supervise(frame, T_wc, renderer, keep=False)
        self.voting_indices.append(frame.index)

    def keyframe_to_relabel(self, keyframes: int) -> int | None:
        """Return which of so many ``keyframes`` to label again, in turn; ask once for every frame."""
        interval = self._config.relabel_interval
        if self._config.votes == 0:
            return None
        self._frames += 1
        if interval == 0 or keyframes == 0 or self._frames % interval != 0:
            return None
        return self._frames // interval % keyframes

    def relabel(self, index: int, depth: Float32, T_wc: Float64, renderer: Renderer) -> Any:
        """Return what a past keyframe is to be fitted to as the map sees it by now; None: as it is.

        Args:
            index: its frame's.
            depth: [gh, gw] metres, at the grid's pixels.
            T_wc: [4, 4] its pose.
            renderer: has rendered the map from there.

        Returns:
            [h, w] int, on the device, the class of each pixel; negative: any.
        """
        surface = PosedDepth(depth, T_wc, self.grid.camera)
        few = self._supervision.relabel(index, surface, self._few(renderer))
        shape = renderer.camera.height, renderer.camera.width
        return None if few is None else self._keyframe_labels.relabelled(index, few, shape)

    def _supervise(
        self, frame: Frame, T_wc: Float64, renderer: Renderer | None, *, keep: bool
    ) -> LabelTargets | None:
        assert frame.depth is not None
        surface = PosedDepth(self.grid.thinned(frame.depth), T_wc, self.grid.camera)
        mask = None if frame.mask is None else self.grid.thinned(frame.mask)
        rendered = None if renderer is None else self._few(renderer)
        return self._supervision.supervise(frame.index, surface, mask, rendered, keep=keep)

    def _few(self, renderer: Renderer) -> Planes:
        return renderer.thinned(self.grid.step)

    def add_classes(self, rendered: Rendered, image: wp.array) -> Rendered:
        """Return ``rendered`` with the classes that it shows; ``image`` [20, Hp, Wp] is it on the device."""
        classes, confidence = self.classifier.classify_image(image, *rendered.opacity.shape)
        return replace(rendered, classes=self.classes.merged(classes), confidence=confidence)

    def add_objects(self, rendered: Rendered, identity: Float32) -> Rendered:
        """Return ``rendered``, which has classes, with the objects as the masks name them, and ``identity``.

        Args:
            identity: [h, w, 16] of the render.
        """
        assert rendered.classes is not None
        objects = np.where(rendered.opacity > _OPAQUE, self.classes.decode(rendered.classes), NO_OBJECT)
        return replace(rendered, identity=identity, objects=objects.astype(np.int32))

    def object_ids(self, part: GaussianMap | None = None) -> tuple[NDArray[np.int32], Float32]:
        """Return [n] the object of each Gaussian as the masks name it, 0 = none, and [n] its probability.

        Args:
            part: another part of the map than is being fitted.
        """
        classes, probabilities = self.classifier.classify_map(part)
        ids = np.where(probabilities > _PROBABLE, self.classes.decode(classes), NO_OBJECT)
        return ids.astype(np.int32), probabilities

    def inventory(
        self, names: dict[int, str], parts: Iterable[GaussianMap] | None = None
    ) -> list[ObjectRecord]:
        """Describe the objects.

        Args:
            names: their classes by id, where known.
            parts: all of the map; None: it is what is being fitted.
        """
        shapes, ids, likely = [], [], []
        for part in [self._map] if parts is None else parts:
            shapes.append(replace(part.to_host(), identities=None, keyframe_ids=None, votes=None))
            found, probabilities = self.object_ids(part)
            ids.append(found)
            likely.append(probabilities)
        gaussians, sources = join(*shapes), self.classes.sources()
        records = inventory(
            gaussians.means,
            gaussians.colours,
            np.concatenate(ids),
            names=self.classes.named(names),
            sources=sources,
            visibility=self.visibility.renamed(self.classes.ids),
            probabilities=np.concatenate(likely),
            extents=gaussians.extents(),
        )
        return [_as_told(r, self._told.get(r.id, {}), anew=r.id in sources) for r in records]

    def linear_classifier(self) -> LinearClassifier:
        """Return the identity classifier on the host."""
        weights, biases = self.classifier.to_host()
        return LinearClassifier(weights, biases, self.classes.ids[: self.classifier.count])


def _as_told(record: ObjectRecord, told: dict[str, Any], *, anew: bool) -> ObjectRecord:
    """Return ``record`` with the names that an earlier map's had, and its sources unless found ``anew``."""
    known = {name: value for name, value in told.items() if value is not None}
    if anew:
        known.pop("source_ids", None)
    return replace(record, **known)
