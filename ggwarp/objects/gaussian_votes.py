# SPDX-License-Identifier: Apache-2.0
"""The votes of the map's Gaussians: what they say of a frame, and a frame's mask among them."""

from __future__ import annotations

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.identity.knowledge import LEVEL_BITS, KnowledgeLimits, tell_knowledge
from ggwarp.kernels.identity.label_fusion import fuse_labels, gather_evidence
from ggwarp.kernels.math import vec16
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Planes
from ggwarp.objects.class_table import IGNORED, ClassTable
from ggwarp.objects.classifier import Classifier
from ggwarp.objects.masks.mask_view import MapKnowledge, MaskView, PosedDepth
from ggwarp.runtime.streams import to_host

_DEPTH_TOLERANCE = 0.03  # a frame shows a Gaussian where their depths agree to this share
_OPAQUE = 0.5
_PROBABLE = 0.7  # the map knows a pixel's object when that is at least so probable...
_KNOWN_VOTES = 2  # ... and so many frames voted there
_CERTAIN_VOTES = 3  # a mask that contradicts so many is not learnt from
_FRESH_LIMIT = 2  # votes of a class to learn fast: one more outnumbers all that came before


class GaussianVotes:
    """A Gaussian's identity is the mean of its votes; this is where they are counted."""

    def __init__(
        self,
        camera: Camera,
        gaussians: GaussianMap,
        classes: ClassTable,
        classifier: Classifier,
        *,
        votes: int,
    ) -> None:
        """Prepare to count.

        Args:
            camera: of the frames' pixels that count.
            classes: says which classes are one object.
            classifier: has the codes of all classes that masks show.
            votes: of a Gaussian that its identity is the mean of, at most.
        """
        self._map = gaussians
        self._classes = classes
        self._classifier = classifier
        self._votes = votes
        self._device = gaussians.device
        self._intrinsics = intrinsics_of(camera)
        self._limits = KnowledgeLimits()
        self._limits.tolerance, self._limits.opacity = _DEPTH_TOLERANCE, _OPAQUE
        self._limits.probability = _PROBABLE
        self._limits.known, self._limits.certain = _KNOWN_VOTES, _CERTAIN_VOTES

    def look(self, surface: PosedDepth, rendered: Planes) -> MapKnowledge:
        """Return what the map knows of ``surface``; ``rendered`` is its view from there, with identities."""
        inverse = se3.inverse(surface.T_wc).astype(np.float32)
        T_cw = wp.array(inverse[None], dtype=wp.mat44, device=self._device)
        depth = wp.array(surface.depth, dtype=float, device=self._device)
        votes, numbers = (wp.empty(depth.shape, dtype=int, device=self._device) for _ in range(2))
        gather_evidence(
            self._map.fields["means"],
            self._map.fields["votes"],
            count=self._map.count,
            T_cw=T_cw,
            camera=self._intrinsics,
            depth=depth,
            tolerance=_DEPTH_TOLERANCE,
            evidence=votes,
            device=self._device,
        )
        classes, probabilities = self._classifier.classify_on_device(rendered.image, *depth.shape)
        tell_knowledge(
            self._limits,
            depth=depth,
            median_depth=rendered.median_depth,
            transmittance=rendered.transmittance,
            classes=classes,
            probabilities=probabilities,
            votes=votes,
            out=numbers,
            device=self._device,
        )
        told = to_host(numbers)
        seen = self._classes.merged(told >> LEVEL_BITS)  # NOTHING is of class -1, IGNORED
        level = told & ((1 << LEVEL_BITS) - 1)
        known, certain = (np.where(level >= least, seen, np.int32(IGNORED)) for least in (1, 2))
        return MapKnowledge(seen, known, certain, T_cw, depth)

    def cast(self, mask: MaskView) -> None:
        """Let each pixel of ``mask`` vote for the Gaussian that it shows."""
        assert mask.knowledge is not None
        codes = self._classifier.codes
        limits = np.full(len(codes), self._votes, np.int32)
        limits[list(mask.fresh)] = min(_FRESH_LIMIT, self._votes)
        fuse_labels(
            self._map.fields["means"],
            count=self._map.count,
            T_cw=mask.knowledge.T_cw,
            camera=self._intrinsics,
            depth=mask.knowledge.depth,
            labels=wp.array(mask.labels, dtype=int, device=self._device),
            codes=wp.array(codes, dtype=vec16, device=self._device),
            tolerance=_DEPTH_TOLERANCE,
            limits=wp.array(limits, dtype=int, device=self._device),
            identities=self._map.fields["identities"],
            votes=self._map.fields["votes"],
            device=self._device,
        )
