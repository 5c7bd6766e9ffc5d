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
from ggwarp.objects.association import Association, SegmentAssociation, TrackedIds
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.classifier import Classifier
from ggwarp.objects.gaussian_votes import GaussianVotes, seen_classes
from ggwarp.objects.id_splitting import SharedIdSplitter, SplittingConfig
from ggwarp.objects.label_history import LabelHistory
from ggwarp.objects.labels import Labels
from ggwarp.objects.mask_view import LabelTargets, MaskView, PosedDepth, targets_without_mask
from ggwarp.objects.merging import ObjectMerger
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float32, Float64, Frame, Rendered


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
        self._votes = GaussianVotes(camera, gaussians, classifier, votes=config.votes)
        self._merger = ObjectMerger(classes, self._history, self._splitter)

    def adopt(self, means: Float32, classes: Labels) -> None:
        """See :meth:`ggwarp.objects.label_history.LabelHistory.adopt`."""
        self._history.adopt(means, classes)

    def supervise(
        self, frame: Frame, T_wc: Float64, rendered: Rendered | None, *, keep: bool = True
    ) -> LabelTargets | None:
        """Let ``frame``'s mask vote, and return what else it asks of the map; None: nothing at all.

        Args:
            frame: with depth.
            T_wc: [4, 4] its pose.
            rendered: the map's view from there; None while the map is empty.
            keep: it is a keyframe: keep its labels for :meth:`relabel`.
        """
        assert frame.depth is not None
        if frame.mask is None:
            return self._without_mask(frame.depth, rendered)
        surface = PosedDepth(frame.depth, T_wc, self._camera)
        knowledge = None if rendered is None else self._votes.look(surface, rendered)
        mask = self._association.associate(frame.mask, surface, knowledge)
        mask = self._splitter.split_shared_ids(mask)
        self._classifier.grow(self._classes.count)
        if self._config.votes == 0:
            return LabelTargets(mask.labels, mask.labels, mask.labels)
        if keep and self._config.relabel_interval > 0:
            self._history.keep(frame.index, mask.labels)
        if knowledge is None:
            return mask.label_targets()
        corrected = self._history.correct(mask)
        self._votes.cast(corrected)
        self._merger.merge_shown_as_one(mask, self._splitter.grown_together(), frame_index=frame.index)
        return corrected.label_targets()

    def relabel(self, index: int, depth: Float32, T_wc: Float64, rendered: Rendered) -> Labels | None:
        """Return a past keyframe's training labels as the map sees it by now; None: it has none.

        Args:
            index: its frame's.
            depth: [h, w] metres.
            T_wc: [4, 4] its pose.
            rendered: the map's view from there.
        """
        labels = self._history.kept(index, depth.shape)
        if labels is None:
            return None
        surface = PosedDepth(depth, T_wc, self._camera)
        knowledge = self._votes.look(surface, rendered)
        knowledge = replace(knowledge, known=knowledge.certain)
        mask = MaskView(surface, labels, knowledge)
        return self._history.correct(mask, anew=False).training_labels()

    def _without_mask(self, depth: Float32, rendered: Rendered | None) -> LabelTargets | None:
        if rendered is None or self._config.votes == 0:
            return None
        return targets_without_mask(seen_classes(depth, rendered))
