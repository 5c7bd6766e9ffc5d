# SPDX-License-Identifier: Apache-2.0
"""What a keyframe's object mask teaches the map, and what the map makes of it.

Masks are taken with a grain of salt. Each of their pixels is a vote for the Gaussian that it shows, and a
Gaussian's identity is the mean of its votes: dots, ragged borders and swapped ids are outvoted. What the map
knows by several votes, in turn, is held against the mask: objects under a wrong id are given their own
back, pixels that contradict the map teach nothing, objects that turn out to be one are joined, and an id that
turns out to be two objects is told apart. Frames that are no keyframes vote, too, and keyframes are looked at
again as the map learns what was wrong with them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.identity.label_fusion import fuse_labels, gather_evidence
from ggwarp.kernels.math import vec16
from ggwarp.kernels.raster.project import intrinsics_of
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.objects.association import AssociatedMask, AssociationConfig, SegmentAssociation
from ggwarp.objects.class_table import IGNORED, NO_OBJECT, ClassTable
from ggwarp.objects.classifier import Classifier
from ggwarp.objects.id_splitting import SharedIdSplitter, SplittingConfig
from ggwarp.objects.label_history import LabelHistory, corrected
from ggwarp.objects.labels import Labels, filled
from ggwarp.objects.mask_view import PosedDepth
from ggwarp.objects.merging import MergingConfig, ObjectMerger
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float64, Frame, Rendered

log = logging.getLogger(__name__)

_FRESH_LIMIT = 2  # one vote more outnumbers all that came before


@dataclass(frozen=True)
class SupervisionConfig:
    """How far object masks are believed."""

    votes: int = 8
    """A Gaussian's identity is the mean over about so many keyframes' labels; 0: labels are believed as
    they come, and only gradients move identities, as published."""
    depth_tolerance: float = 0.03
    """A keyframe shows a Gaussian where their depths agree to this share."""
    sure: float = 0.7
    """The map knows a pixel's object when that is at least so probable..."""
    evidence: int = 2
    """... and so many keyframes voted there."""
    contradiction: int = 3
    """Pixels that contradict the map teach nothing where so many keyframes voted."""
    watch: int = 2
    """Frames that are no keyframes vote with their masks, too, but for one in so many, where objects can be
    measured; 0: none does."""
    revise: int = 1
    """Every so many frames a past keyframe, in turn, is held against what the map knows by now; 0: none."""
    joining: MergingConfig = field(default_factory=MergingConfig)
    namesakes: SplittingConfig = field(default_factory=SplittingConfig)
    matching: AssociationConfig = field(default_factory=AssociationConfig)


@dataclass(frozen=True)
class LabelTargets:
    """What a keyframe teaches about objects.

    Attributes:
        labels: [h, w] class that each pixel votes for; negative: none.
        targets: [h, w] class that the rendered identity should have; negative: any.
        seeds: [h, w] class of Gaussians that begin here; negative: not known.
    """

    labels: Labels
    targets: Labels
    seeds: Labels


@dataclass(frozen=True)
class _Knowledge:
    """What the map knows where a frame shows its surface, [h, w] each.

    Attributes:
        seen: the likeliest class; negative: it shows something else.
        sure: the same where that is probable.
        evidence: votes behind it.
    """

    seen: Labels
    sure: Labels
    evidence: NDArray[np.uint8]

    def with_evidence(self, votes: int) -> Labels:
        """Return ``sure`` where so many votes are behind it, else negative."""
        return np.where(self.evidence >= votes, self.sure, IGNORED)


class ObjectSupervision:
    """Turns masks into lessons, and keeps each Gaussian's votes."""

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
        """Prepare to teach ``gaussians``.

        Args:
            classes: grows with the objects.
            classifier: grows with them.
            tracked: whether the masks' ids mean the same object in every frame.
        """
        self._config = config
        self._map = gaussians
        self._classes = classes
        self._classifier = classifier
        self._device = gaussians.device
        self._camera, self._intrinsics = camera, intrinsics_of(camera)
        self._matcher = None if tracked else SegmentAssociation(config.matching, classes)
        self._history = LabelHistory()
        self._joining = ObjectMerger(config.joining)
        self._namesakes = SharedIdSplitter(config.namesakes, classes)
        self._given: dict[int, NDArray[np.uint8]] = {}

    def teach(
        self, frame: Frame, T_wc: Float64, rendered: Rendered | None, *, keep: bool = True
    ) -> LabelTargets | None:
        """Let ``frame``'s mask vote, and return what else it teaches; None: nothing at all.

        Args:
            frame: with depth.
            T_wc: [4, 4] its pose.
            rendered: the map's view from there; None while the map is empty.
            keep: it is a keyframe: keep its labels for :meth:`revise`.
        """
        c = self._config
        if frame.mask is None:
            return None if rendered is None or c.votes == 0 else _without_mask(self._seen(frame, rendered))
        T_cw, depth = self._uploaded(frame, T_wc)
        knows = None if rendered is None else self._look(frame, T_cw, depth, rendered)
        known = None if knows is None else knows.with_evidence(c.evidence)
        view = self._view(frame, T_wc)
        mask = self._understood(frame.mask, view, None if knows is None else knows.seen, known)
        given = mask.labels
        self._classifier.grow(self._classes.count)
        if c.votes == 0:
            return LabelTargets(given, given, given)
        if keep and c.revise > 0:
            self._given[frame.index] = _packed(given)
        if knows is None or known is None:
            return LabelTargets(given, given, filled(given))
        labels = self._put_right(known, given, view)
        self._fuse(T_cw, depth, labels, mask.fresh)
        self._merge(known, mask.segments, frame.index)
        contradicting = knows.with_evidence(c.contradiction)
        return LabelTargets(labels, _uncontradicted(labels, contradicting), filled(labels))

    def revise(self, frame: Frame, T_wc: Float64, rendered: Rendered) -> Labels | None:
        """Return a past keyframe's ``LabelTargets.targets`` as the map sees it by now; None: it has none.

        Args:
            frame: the keyframe; its mask does not matter.
            T_wc: [4, 4] its pose.
            rendered: the map's view from there.
        """
        packed = self._given.get(frame.index)
        if packed is None:
            return None
        knows = self._look(frame, *self._uploaded(frame, T_wc), rendered)
        known = knows.with_evidence(self._config.contradiction)
        given = self._classes.joined(_unpacked(packed))
        labels = self._put_right(known, given, self._view(frame, T_wc), anew=False)
        return _uncontradicted(labels, known)

    def _uploaded(self, frame: Frame, T_wc: Float64) -> tuple[wp.array, wp.array]:
        """Return the pose as the kernels want it, and the depth."""
        T_cw = wp.array(se3.inverse(T_wc).astype(np.float32)[None], dtype=wp.mat44, device=self._device)
        return T_cw, wp.array(frame.depth, dtype=float, device=self._device)

    def _look(self, frame: Frame, T_cw: wp.array, depth: wp.array, rendered: Rendered) -> _Knowledge:
        """Return what the map knows of the surface that the frame shows."""
        assert rendered.confidence is not None
        seen = self._seen(frame, rendered)
        sure = np.where(rendered.confidence >= self._config.sure, seen, IGNORED)
        return _Knowledge(seen, sure, self._evidence(T_cw, depth))

    def _seen(self, frame: Frame, rendered: Rendered) -> Labels:
        """Return [h, w] the map's class where it shows the frame's surface, else negative."""
        assert frame.depth is not None and rendered.classes is not None
        same = np.abs(rendered.median_depth - frame.depth) <= self._config.depth_tolerance * frame.depth
        shown = same & (frame.depth > 0.0) & (rendered.opacity > 0.5)
        return np.where(shown, self._classes.joined(rendered.classes), IGNORED)

    def _view(self, frame: Frame, T_wc: Float64) -> PosedDepth:
        assert frame.depth is not None
        return PosedDepth(frame.depth, T_wc, self._camera)

    def _understood(
        self, mask: Labels, view: PosedDepth, seen: Labels | None, known: Labels | None
    ) -> AssociatedMask:
        """Return which object each of the mask's pixels is of; ``seen``, ``known``: None without a map."""
        if self._matcher is not None:
            return self._matcher.match(mask, seen, view)
        given, fresh = self._classes.encode(mask), set[int]()
        if self._config.votes > 0:
            given, fresh = self._namesakes.tell_apart(given, known, view)
        return AssociatedMask(given, np.where(given == NO_OBJECT, IGNORED, given), fresh)

    def _put_right(self, known: Labels, given: Labels, view: PosedDepth, *, anew: bool = True) -> Labels:
        """Return the labels of a mask with those replaced that are wrong about an object of the map."""
        wrong = self._history.overruled(known, given, view, anew=anew)
        # Of an id's objects the place says which it is.
        wrong = [pair for pair in wrong if not self._classes.share_an_id(*pair)]
        return corrected(known, given, wrong) if wrong else given

    def _merge(self, known: Labels, segments: Labels, index: int) -> None:
        """Join the objects that frame ``index`` shows to be one."""
        pairs = self._joining.see(known, segments, own_names=self._matcher is None)
        pairs = [pair for pair in pairs if not self._classes.share_an_id(*pair)]
        for kept, gone in pairs + self._namesakes.touching():
            ids = self._classes.ids
            log.info("frame %d: objects %d and %d are one", index, ids[kept], ids[gone])
            self._classes.join(kept, gone)
            for record in (self._joining, self._history, self._namesakes):
                record.join(kept, gone)

    def _evidence(self, T_cw: wp.array, depth: wp.array) -> Any:
        """Return [h, w] how many votes are behind what the map shows."""
        counts = wp.empty(depth.shape, dtype=int, device=self._device)
        gather_evidence(
            self._map.fields["means"],
            self._map.fields["votes"],
            count=self._map.count,
            T_cw=T_cw,
            camera=self._intrinsics,
            depth=depth,
            tolerance=self._config.depth_tolerance,
            evidence=counts,
            device=self._device,
        )
        # Centres are sparser than pixels.
        return cv2.dilate(to_host(counts).astype(np.uint8), np.ones((3, 3), np.uint8))

    def _fuse(self, T_cw: wp.array, depth: wp.array, labels: Labels, fresh: set[int]) -> None:
        limits = np.full(self._classes.count, self._config.votes, np.int32)
        limits[list(fresh)] = min(_FRESH_LIMIT, self._config.votes)
        fuse_labels(
            self._map.fields["means"],
            count=self._map.count,
            T_cw=T_cw,
            camera=self._intrinsics,
            depth=depth,
            labels=wp.array(labels, dtype=int, device=self._device),
            codes=wp.array(self._classifier.codes, dtype=vec16, device=self._device),
            tolerance=self._config.depth_tolerance,
            limits=wp.array(limits, dtype=int, device=self._device),
            identities=self._map.fields["identities"],
            votes=self._map.fields["votes"],
            device=self._device,
        )


def _uncontradicted(labels: Labels, known: Labels) -> Labels:
    """Return ``labels`` without those that the map contradicts."""
    return np.where((known >= 0) & (known != labels), IGNORED, labels)


def _packed(labels: Labels) -> NDArray[np.uint8]:
    """Return labels as a PNG: a few kilobytes, where the image would be megabytes."""
    return np.asarray(cv2.imencode(".png", (labels - IGNORED).astype(np.uint16))[1], np.uint8)


def _unpacked(packed: NDArray[np.uint8]) -> Labels:
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_UNCHANGED), np.int32) + IGNORED


def _without_mask(seen: Labels) -> LabelTargets:
    """A frame without a mask votes for nothing; what begins there goes with its surroundings for now."""
    nothing = np.full_like(seen, IGNORED)
    return LabelTargets(
        nothing, nothing, filled(seen) if (seen >= 0).any() else np.full_like(seen, NO_OBJECT)
    )
