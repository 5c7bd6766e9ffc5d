# SPDX-License-Identifier: Apache-2.0
"""What a keyframe's object mask teaches the map, and what the map makes of it.

Masks are taken with a grain of salt. Each of their pixels is a vote for the Gaussian that it shows, and a
Gaussian's identity is the mean of its votes: dots, ragged borders and swapped ids are outvoted. What the map
knows by several votes, in turn, is held against the mask: objects under a wrong id are given their own
back, and pixels that contradict the map teach nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import warp as wp

from ggwarp.kernels.fusion import fuse_labels, gather_evidence
from ggwarp.kernels.math import vec16
from ggwarp.kernels.project import intrinsics_of
from ggwarp.kernels.streams import to_host
from ggwarp.map.gaussians import GaussianMap
from ggwarp.objects.agreement import LabelHistory, corrected
from ggwarp.objects.classifier import Classifier
from ggwarp.objects.labels import Labels, filled
from ggwarp.objects.registry import IGNORED, NO_OBJECT, ClassTable
from ggwarp.types import Camera, Frame, Rendered


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


@dataclass(frozen=True)
class Lesson:
    """What a keyframe teaches about objects.

    Attributes:
        labels: [h, w] class that each pixel votes for; negative: none.
        targets: [h, w] class that the rendered identity should have; negative: any.
        seeds: [h, w] class of Gaussians that begin here; negative: not known.
    """

    labels: Labels
    targets: Labels
    seeds: Labels


class ObjectSupervision:
    """Turns masks into lessons, and keeps each Gaussian's votes.

    Attributes:
        history: what the map's objects were called.
    """

    def __init__(
        self,
        config: SupervisionConfig,
        camera: Camera,
        gaussians: GaussianMap,
        classes: ClassTable,
        classifier: Classifier,
    ) -> None:
        self._config = config
        self._map = gaussians
        self._classes = classes
        self._classifier = classifier
        self._device = gaussians.device
        self._intrinsics = intrinsics_of(camera)
        self.history = LabelHistory()

    def teach(self, frame: Frame, T_cw: wp.array, rendered: Rendered | None) -> Lesson | None:
        """Let ``frame``'s mask vote, and return what else it teaches; None: nothing at all.

        Args:
            frame: the keyframe, with depth.
            T_cw: [1] mat44, its pose, world to camera.
            rendered: the map's view from there; None while the map is empty.
        """
        if frame.mask is None:
            seen = None if rendered is None or self._config.votes == 0 else self._seen(frame, rendered)
            return None if seen is None else _without_mask(seen)
        given = self._classes.encode(frame.mask)
        self._classifier.grow(self._classes.count)
        if self._config.votes == 0:
            return Lesson(given, given, given)
        if rendered is None:
            return Lesson(given, given, filled(given))
        return self._weighed(frame, T_cw, rendered, given)

    def _weighed(self, frame: Frame, T_cw: wp.array, rendered: Rendered, given: Labels) -> Lesson:
        """Hold the mask's classes ``given`` [h, w] against the map, and let the map learn from them."""
        c = self._config
        depth = wp.array(frame.depth, dtype=float, device=self._device)
        evidence = self._evidence(T_cw, depth)
        assert rendered.confidence is not None
        sure = np.where(rendered.confidence >= c.sure, self._seen(frame, rendered), IGNORED)
        known = np.where(evidence >= c.evidence, sure, IGNORED)
        wrong = self.history.overruled(known, given, self._classes.count)
        labels = corrected(known, given, wrong) if wrong else given
        self._fuse(T_cw, depth, labels)
        contradicted = (sure >= 0) & (sure != labels) & (evidence >= c.contradiction)
        return Lesson(labels, np.where(contradicted, IGNORED, labels), filled(labels))

    def _seen(self, frame: Frame, rendered: Rendered) -> Labels:
        """Return [h, w] the map's class where it shows the frame's surface, else negative."""
        assert frame.depth is not None and rendered.objects is not None
        same = np.abs(rendered.median_depth - frame.depth) <= self._config.depth_tolerance * frame.depth
        shown = same & (frame.depth > 0.0) & (rendered.opacity > 0.5)
        return np.where(shown, self._classes.find(rendered.objects), IGNORED)

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

    def _fuse(self, T_cw: wp.array, depth: wp.array, labels: Labels) -> None:
        fuse_labels(
            self._map.fields["means"],
            count=self._map.count,
            T_cw=T_cw,
            camera=self._intrinsics,
            depth=depth,
            labels=wp.array(labels, dtype=int, device=self._device),
            codes=wp.array(self._classifier.codes, dtype=vec16, device=self._device),
            tolerance=self._config.depth_tolerance,
            limit=self._config.votes,
            identities=self._map.fields["identities"],
            votes=self._map.fields["votes"],
            device=self._device,
        )


def _without_mask(seen: Labels) -> Lesson:
    """A frame without a mask votes for nothing; what begins there goes with its surroundings for now."""
    nothing = np.full_like(seen, IGNORED)
    return Lesson(nothing, nothing, filled(seen) if (seen >= 0).any() else np.full_like(seen, NO_OBJECT))
