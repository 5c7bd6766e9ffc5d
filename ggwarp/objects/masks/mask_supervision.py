# SPDX-License-Identifier: Apache-2.0
"""How object masks supervise the map's identities, and how the map corrects the masks.

Masks are taken with a grain of salt. Each of their pixels is a vote for the Gaussian that it shows, and a
Gaussian's identity is the mean of its votes: dots, ragged borders and swapped ids are outvoted. What the map
knows by several votes, in turn, is held against the mask: objects under a wrong id are given their own
back, pixels that contradict the map are not learnt from, objects that turn out to be one are merged, and an
id that turns out to be two objects is split. Frames that are no keyframes vote, too, and keyframes are
labelled again as the map learns what was wrong with them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Planes
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.classifier import Classifier
from ggwarp.objects.gaussian_votes import GaussianVotes
from ggwarp.objects.labels import Labels
from ggwarp.objects.masks.association import Association, SegmentAssociation, TrackedIds
from ggwarp.objects.masks.id_splitting import SharedIdSplitter, SplittingConfig
from ggwarp.objects.masks.label_history import LabelHistory
from ggwarp.objects.masks.mask_view import LabelTargets, MaskView, PosedDepth, targets_without_mask
from ggwarp.objects.masks.merging import ObjectMerger
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32


@dataclass(frozen=True)
class SupervisionConfig:
    """How masks move the map, and the map the masks."""

    votes: int = 8
    """A Gaussian's identity is the mean over the labels of about N frames; 0: labels are taken as they come,
    and only gradients move identities, as published."""
    vote_interval: int = 2
    """Masks of frames that are no keyframes vote, too, except every N-th, where objects can be measured;
    0: none of them votes."""
    relabel_interval: int = 1
    """Every N-th frame, a past keyframe, in turn, is held against what the map knows by now; 0: never."""
    splitting: SplittingConfig = field(default_factory=SplittingConfig)


class ObjectSupervision(Stateful):
    """Takes masks to the map, stage by stage."""

    STATE = ("_association", "_splitter", "_history", "_merger")

    def __init__(
        self,
        config: SupervisionConfig,
        camera: Camera,
        gaussians: GaussianMap,
        classes: ClassTable,
        classifier: Classifier,
        *,
        tracked: bool = True,
    ) -> None:
        """Prepare to supervise ``gaussians``.

        Args:
            camera: of the pixels that are looked at.
            classes: grows with the objects.
            classifier: grows with them.
            tracked: whether the masks' ids mean the same object in every frame.
        """
        self._config = config
        self._camera = camera
        self._classes = classes
        self._classifier = classifier
        self._association: Association = TrackedIds(classes) if tracked else SegmentAssociation(classes)
        splitting = config.splitting if tracked and config.votes > 0 else SplittingConfig(views=0)
        self._splitter = SharedIdSplitter(splitting, classes)
        self._history = LabelHistory(classes)
        self._votes = GaussianVotes(camera, gaussians, classes, classifier, votes=config.votes)
        self._merger = ObjectMerger(classes, self._history, self._splitter)

    def adopt(self, means: Float32, classes: Labels) -> None:
        """See :meth:`ggwarp.objects.masks.label_history.LabelHistory.adopt`."""
        self._history.adopt(means, classes)

    def supervise(
        self,
        index: int,
        surface: PosedDepth,
        mask: Labels | None,
        rendered: Planes | None,
        *,
        keep: bool = True,
    ) -> LabelTargets | None:
        """Let a frame's mask vote, and return what else it asks of the map; None: nothing at all.

        Args:
            index: the frame's.
            surface: where its pixels are.
            mask: [h, w] its object ids; None: it has none.
            rendered: the map's view from there, with identities; None while the map is empty.
            keep: it is a keyframe: keep its labels for :meth:`relabel`.
        """
        if mask is None and (rendered is None or self._config.votes == 0):
            return None
        knowledge = None if rendered is None else self._votes.look(surface, rendered)
        if mask is None:
            return None if knowledge is None else targets_without_mask(knowledge.seen)
        view = self._association.associate(mask, surface, knowledge)
        view = self._splitter.split_shared_ids(view)
        self._classifier.grow(self._classes.count)
        if self._config.votes == 0:
            return LabelTargets(view.labels, view.labels, view.labels)
        if keep and self._config.relabel_interval > 0:
            self._history.keep(index, view.labels)
        if knowledge is None:
            return view.label_targets()
        corrected = self._history.correct(view)
        self._votes.cast(corrected)
        self._merger.merge_shown_as_one(view, self._splitter.grown_together(), frame_index=index)
        return corrected.label_targets()

    def relabel(self, index: int, surface: PosedDepth, rendered: Planes) -> Labels | None:
        """Return a past keyframe's training labels [h, w] as the map sees it by now; None: it has none.

        Args:
            index: its frame's.
            surface: where its pixels are.
            rendered: the map's view from there, with identities.
        """
        labels = self._history.kept(index, surface.depth.shape)
        if labels is None:
            return None
        knowledge = self._votes.look(surface, rendered)
        knowledge = replace(knowledge, known=knowledge.certain)
        mask = MaskView(surface, labels, knowledge)
        return self._history.correct(mask, anew=False).training_labels()
