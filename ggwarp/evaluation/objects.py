# SPDX-License-Identifier: Apache-2.0
"""How well rendered object ids agree with the masks: IoU, panoptic quality, pixel accuracy.

Counts are summed over the whole sequence, object by object, before any ratio is taken. Every
labelled pixel counts; "no object" (id 0) is not itself averaged, but an object painted over it
loses, and so does one that is missing. Negative ids are unlabelled pixels.

A map built from untracked masks names its objects anew: the *matched* figures first pair true
and rendered objects one to one, over the whole sequence, so that the most pixels agree.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int32]

BORDER = 2
"""Rendered pixels on either side of a true mask's border that the interior figures leave out."""
_SEGMENT_IOU = 0.5  # above it at most one segment can match another (Kirillov et al., 2019)


@dataclass(frozen=True, kw_only=True)
class ObjectFigures:
    """What is said of a sequence's objects; None = not measured.

    Attributes:
        miou: mean IoU over the masks' objects, each with the rendered object of its own id.
        miou_matched: the same after one-to-one matching; an object left without a match counts 0.
        miou_interior: as ``miou``, pixels within :data:`BORDER` of a true mask's border left out.
        pq, sq, rq: panoptic quality = segmentation quality x recognition quality (Kirillov et al.,
            *Panoptic Segmentation*, 2019). A segment is an object in an image; one is recognised when
            its matched object overlaps it there by an IoU above 0.5.
        pixel_accuracy: share of labelled pixels with the right id, "no object" included.
        objects_true, objects_found: objects that the masks and the renders show in any image.
    """

    miou: float | None = None
    miou_matched: float | None = None
    miou_interior: float | None = None
    pq: float | None = None
    sq: float | None = None
    rq: float | None = None
    pixel_accuracy: float | None = None
    objects_true: int | None = None
    objects_found: int | None = None


@dataclass(frozen=True)
class ObjectRow:
    """One true object over the sequence.

    Attributes:
        id: as the masks name it.
        pixels, rendered_pixels: of the true object and of the rendered one of the same id.
        iou, iou_interior: with the rendered object of the same id; None: no pixel of it counts.
        matched_id: the rendered object that matching gives it; None: none is left that touches it.
        iou_matched: with that one, else 0.
    """

    id: int
    pixels: int
    rendered_pixels: int
    iou: float
    iou_interior: float | None
    matched_id: int | None
    iou_matched: float


@dataclass(frozen=True)
class _Pairs:
    """Pixel counts [k] of the pairs of a true and a rendered id that occur together."""

    true: NDArray[np.int64]
    rendered: NDArray[np.int64]
    pixels: NDArray[np.int64]

    @staticmethod
    def of(true: Ids, rendered: Ids) -> _Pairs:
        """Count two equally long rows of ids."""
        if true.size == 0:
            return _Pairs.sum([])
        # Masks are made of runs: only a run's first pixel is sorted, not every pixel.
        starts = np.flatnonzero((true[1:] != true[:-1]) | (rendered[1:] != rendered[:-1])) + 1
        starts = np.concatenate([[0], starts])
        lengths = np.diff(np.append(starts, true.size))
        return _Pairs._grouped(true[starts].astype(np.int64), rendered[starts].astype(np.int64), lengths)

    @staticmethod
    def sum(parts: Iterable[_Pairs]) -> _Pairs:
        """Return the counts of all ``parts`` together."""
        listed = list(parts)
        if not listed:
            empty = np.zeros(0, np.int64)
            return _Pairs(empty, empty, empty)
        columns = [[getattr(p, name) for p in listed] for name in ("true", "rendered", "pixels")]
        return _Pairs._grouped(*(np.concatenate(c) for c in columns))

    @staticmethod
    def _grouped(true: NDArray[np.int64], rendered: NDArray[np.int64], pixels: NDArray[np.int64]) -> _Pairs:
        # Ids are 32-bit: a pair of them fits one sortable number.
        keys, group = np.unique((true << 32) | rendered, return_inverse=True)
        totals = np.zeros(len(keys), np.int64)
        np.add.at(totals, group, pixels)
        return _Pairs(keys >> 32, keys & 0xFFFFFFFF, totals)


class _Overlaps:
    """Intersections and unions of every true with every rendered object.

    Attributes:
        true, rendered: [T], [R] ids above 0, rising.
        true_pixels, rendered_pixels: [T], [R].
        intersections: [T, R] pixels. ious: [T, R].
    """

    def __init__(self, pairs: _Pairs) -> None:
        true, rows = np.unique(pairs.true, return_inverse=True)
        rendered, columns = np.unique(pairs.rendered, return_inverse=True)
        counts = np.zeros((len(true), len(rendered)), np.int64)
        counts[rows, columns] = pairs.pixels
        is_object, is_rendered = true > 0, rendered > 0
        self.true, self.rendered = true[is_object], rendered[is_rendered]
        self.true_pixels, self.rendered_pixels = counts.sum(1)[is_object], counts.sum(0)[is_rendered]
        self.intersections = counts[is_object][:, is_rendered]
        unions = self.true_pixels[:, None] + self.rendered_pixels - self.intersections
        self.ious = self.intersections / unions

    def iou(self, true: int, rendered: int | None) -> float | None:
        """Return the IoU of two objects; None when the masks do not show ``true``, 0 without a render."""
        if true not in self._rows:
            return None
        column = None if rendered is None else self._columns.get(rendered)
        return 0.0 if column is None else float(self.ious[self._rows[true], column])

    def matching(self) -> dict[int, int]:
        """Return true id -> rendered id, one to one, with the most pixels in common (Kuhn, 1955)."""
        from scipy.optimize import linear_sum_assignment  # heavy, and not needed before a run has ended

        pairs = zip(*linear_sum_assignment(self.intersections, maximize=True), strict=True)
        return {int(self.true[t]): int(self.rendered[r]) for t, r in pairs if self.intersections[t, r] > 0}

    @cached_property
    def _rows(self) -> dict[int, int]:
        return {i: k for k, i in enumerate(self.true.tolist())}

    @cached_property
    def _columns(self) -> dict[int, int]:
        return {i: k for k, i in enumerate(self.rendered.tolist())}


class ObjectScore:
    """Gathers images and tells how well their objects agree."""

    def __init__(self) -> None:
        self._images: list[_Pairs] = []
        self._interiors: list[_Pairs] = []

    def add(self, rendered: Ids, true: Ids) -> None:
        """Count one image at the size of ``true``: object ids, 0 = no object.

        Args:
            rendered: [h, w] 0 or above; each of the true mask's pixels is held against the one it falls into.
            true: [H, W]; negative ids are not counted.
        """
        (height, width), (h, w) = true.shape, rendered.shape
        if true.shape != rendered.shape:
            rows = ((np.arange(height) + 0.5) * h / height).astype(np.intp)
            columns = ((np.arange(width) + 0.5) * w / width).astype(np.intp)
            rendered = rendered[rows[:, None], columns]
        labelled = true >= 0
        self._images.append(_Pairs.of(true[labelled], rendered[labelled]))
        inside = interior(true, round(BORDER * max(1.0, width / w))) & labelled
        self._interiors.append(_Pairs.of(true[inside], rendered[inside]))

    def __bool__(self) -> bool:
        """Whether any image was counted."""
        return bool(self._images)

    def __add__(self, other: ObjectScore) -> ObjectScore:
        """Return the score of the images of both."""
        total = ObjectScore()
        total._images = self._images + other._images
        total._interiors = self._interiors + other._interiors
        return total

    def figures(self) -> ObjectFigures:
        """Return the sequence's figures; None where the masks show nothing to measure."""
        pairs = _Pairs.sum(self._images)
        pixels = int(pairs.pixels.sum())
        if not pixels:
            return ObjectFigures()
        rows = self.table()
        right = int(pairs.pixels[pairs.true == pairs.rendered].sum())
        pq, sq, rq = self._panoptic({r.id: r.matched_id for r in rows})
        return ObjectFigures(
            miou=_mean([r.iou for r in rows]),
            miou_matched=_mean([r.iou_matched for r in rows]),
            miou_interior=_mean([r.iou_interior for r in rows if r.iou_interior is not None]),
            pq=pq,
            sq=sq,
            rq=rq,
            pixel_accuracy=right / pixels,
            objects_true=len(rows),
            objects_found=len(np.unique(pairs.rendered[pairs.rendered > 0])),
        )

    def table(self) -> list[ObjectRow]:
        """Return a row for every object that the masks show, by id."""
        whole, inside = _Overlaps(_Pairs.sum(self._images)), _Overlaps(_Pairs.sum(self._interiors))
        matching = whole.matching()
        rendered_pixels = dict(zip(whole.rendered.tolist(), whole.rendered_pixels.tolist(), strict=True))
        return [
            ObjectRow(
                id=i,
                pixels=pixels,
                rendered_pixels=rendered_pixels.get(i, 0),
                iou=whole.iou(i, i) or 0.0,
                iou_interior=inside.iou(i, i),
                matched_id=matching.get(i),
                iou_matched=whole.iou(i, matching.get(i)) or 0.0,
            )
            for i, pixels in zip(whole.true.tolist(), whole.true_pixels.tolist(), strict=True)
        ]

    def _panoptic(self, matching: dict[int, int | None]) -> tuple[float | None, float | None, float | None]:
        """Return PQ, SQ and RQ of the images' segments under ``matching``."""
        hits: list[float] = []
        segments = 0
        for image in self._images:
            overlaps = _Overlaps(image)
            segments += len(overlaps.true) + len(overlaps.rendered)
            ious = [overlaps.iou(i, matching[i]) or 0.0 for i in overlaps.true.tolist()]
            hits += [iou for iou in ious if iou > _SEGMENT_IOU]
        if not segments:
            return None, None, None
        # Half the false positives and half the false negatives, plus the hits, are half of all segments.
        return 2.0 * sum(hits) / segments, _mean(hits), 2.0 * len(hits) / segments


def interior(mask: Ids, border: int = BORDER) -> NDArray[np.bool_]:
    """Return where all pixels of ``mask`` [h, w] within ``border`` rows and columns have the same id."""
    window = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    values = mask.astype(np.float64)  # OpenCV has no 32-bit integer form; this one is exact
    return np.equal(cv2.erode(values, window), cv2.dilate(values, window))


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
