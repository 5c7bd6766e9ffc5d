# SPDX-License-Identifier: Apache-2.0
"""A frame's object mask on its way to the map: the values that pass between the stages of supervision."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.objects.class_table import IGNORED, NO_OBJECT
from ggwarp.objects.labels import Labels, contingency_with_unknown, filled
from ggwarp.types import Float32, Float64

_TOLERANCE = 0.05  # of the depth: a view shows a point that is no farther from its surface


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> Float32:
    """Return [3, h * w] where the pixels of ``camera`` look, camera frame."""
    rows, columns = np.indices((camera.height, camera.width))
    return np.ascontiguousarray(camera.rays(columns.ravel(), rows.ravel()).T, np.float32)


@dataclass(frozen=True)
class PosedDepth:
    """Where a frame's pixels are in the world.

    Attributes:
        depth: [h, w] metres.
        T_wc: [4, 4] pose.
        camera: of the pixels.
    """

    depth: Float32
    T_wc: Float64
    camera: Camera

    @cached_property
    def places(self) -> Float32:
        """[3, h * w] the points that the pixels show, world frame; the camera's own place without depth."""
        T_wc = self.T_wc.astype(np.float32)
        return T_wc[:3, :3] @ _rays(self.camera) * self.depth.ravel() + T_wc[:3, 3:]

    def points(self, pixels: NDArray[np.bool_], most: int) -> Float64:
        """Return [k, 3] at ``most`` points of the surface at ``pixels`` [h, w], world frame, evenly drawn."""
        rows, columns = np.nonzero(pixels & (self.depth > 0.0))
        chosen = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int)
        return self._points(rows[chosen], columns[chosen])

    def _points(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Float64:
        z = self.depth[rows, columns].astype(np.float64)
        p = self.camera.back_project(columns, rows, z)
        return p @ self.T_wc[:3, :3].T + self.T_wc[:3, 3]

    def look_up(self, points: Float64, image: Labels) -> Labels:
        """Return ``image`` [h, w] at those of ``points`` [k, 3] that the view shows."""
        p = (points - self.T_wc[:3, 3]) @ self.T_wc[:3, :3]
        rows, columns, inside = self.camera.pixels_of(p)
        rows, columns, z = rows[inside], columns[inside], p[inside, 2]
        shown = np.abs(self.depth[rows, columns] - z) <= _TOLERANCE * z
        return image[rows[shown], columns[shown]]


@dataclass(frozen=True)
class MapKnowledge:
    """What the map knows of the surface that a frame shows, [h, w] each.

    Attributes:
        seen: the likeliest class; negative: the map shows something else.
        known: the same where it is probable and several frames voted for it, else negative.
        certain: the same where still more frames voted, else negative: the map knows better than a mask.
        T_cw, depth: the frame's pose, [1] mat44, and depth, on the device.
    """

    seen: Labels
    known: Labels
    certain: Labels
    T_cw: Any = None
    depth: Any = None


@dataclass(frozen=True)
class MaskView:
    """What a mask says of a frame, and what it is held against.

    Attributes:
        surface: where the pixels are.
        labels: [h, w] class of each pixel; negative: not known.
        knowledge: the map's view of the same; None while the map is empty.
        segments: [h, w] segment of each pixel, negative: none; None: each object's pixels are one segment,
            which bears the object's number.
        fresh: classes that the map shows as others so far, and is to learn fast.
    """

    surface: PosedDepth
    labels: Labels
    knowledge: MapKnowledge | None = None
    segments: Labels | None = None
    fresh: frozenset[int] = frozenset()

    @cached_property
    def known(self) -> Labels:
        """[h, w] the class that the map knows where there is depth; negative: none."""
        assert self.knowledge is not None
        return np.where(self.surface.depth > 0.0, self.knowledge.known, np.int32(IGNORED))

    @cached_property
    def overlaps(self) -> NDArray[np.int64]:
        """[k + 1, k + 1] pixels by :attr:`known` class and by label, from -1, not known, on."""
        classes = int(max(self.known.max(), self.labels.max(), 0)) + 1
        return contingency_with_unknown(self.known, self.labels, classes)

    def with_labels(self, labels: Labels, *fresh: int) -> MaskView:
        """Return the same with other ``labels`` [h, w], and more classes to learn fast."""
        return replace(self, labels=labels, fresh=self.fresh.union(fresh))

    def training_labels(self) -> Labels:
        """Return the labels without those that contradict what the map is certain of."""
        if self.knowledge is None:
            return self.labels
        certain = self.knowledge.certain
        return np.where((certain >= 0) & (certain != self.labels), IGNORED, self.labels)

    def label_targets(self) -> LabelTargets:
        """Return what the mask asks of the map."""
        return LabelTargets(self.labels, self.training_labels(), filled(self.labels))


@dataclass(frozen=True)
class LabelTargets:
    """What a frame asks of the map's identities, [h, w] each.

    Attributes:
        votes: class that each pixel votes for; negative: none.
        training: class that the rendered identity should have; negative: any.
        seeds: class of Gaussians that begin here; negative: not known.
    """

    votes: Labels
    training: Labels
    seeds: Labels


def targets_without_mask(seen: Labels) -> LabelTargets:
    """Return the targets of a frame without a mask: what begins there goes with its surroundings for now.

    Args:
        seen: as of :class:`MapKnowledge`.
    """
    nothing = np.full_like(seen, IGNORED)
    known = (seen >= 0).any()
    return LabelTargets(nothing, nothing, filled(seen) if known else np.full_like(seen, NO_OBJECT))
