# SPDX-License-Identifier: Apache-2.0
"""What a sequence is taken for: layout, pairing, camera, depth's unit, masks, truth, and what is not read."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import Dataset, DatasetError, FrameError, is_live
from ggwarp.datasets.plan.camera_checks import camera_doubts, field_of_view
from ggwarp.datasets.plan.correspondence import edges_of_depth, judge, neighbours
from ggwarp.datasets.plan.depth_checks import depth_faults, depth_statistics
from ggwarp.datasets.plan.focal_check import View, focal_doubt, pairs_around, view_of
from ggwarp.datasets.plan.mask_checks import mask_doubts
from ggwarp.datasets.source import source_of
from ggwarp.types import Frame

SAMPLES = 6
"""Frames that are looked at, spread over the sequence."""


@dataclass(frozen=True)
class SequencePlan:
    """How a sequence is read, and what was found by looking at a few of its frames.

    Attributes:
        layout, pairing, camera, depth, masks, truth: in words; empty: none, or not known.
        frames: how many.
        median_depth_m: metres, of the frames looked at; None: there is no depth.
        valid_depth: share of their pixels with a reading; None: there is no depth.
        unread: what is there and is not read.
        warnings: what may be wrong.
        looked_at: the frames looked at, as they are.
    """

    layout: str
    frames: int
    pairing: str
    camera: str
    depth: str
    median_depth_m: float | None
    valid_depth: float | None
    masks: str
    truth: str
    unread: tuple[str, ...]
    warnings: tuple[str, ...]
    looked_at: tuple[Frame, ...] = ()

    def lines(self) -> Iterator[str]:
        """Yield the plan, a subject a line."""
        rows = (
            ("sequence", self.layout),
            ("pairing", self.pairing),
            ("camera", self.camera),
            ("depth", self.depth),
            ("masks", self.masks),
            ("truth", self.truth),
            ("not read", ", ".join(self.unread)),
        )
        for subject, text in rows:
            if text:
                yield f"{subject + ':':10}{text}"

    def to_json(self) -> dict[str, Any]:
        """Return the plan as ``metrics.json`` has it."""
        names = ("layout", "frames", "pairing", "camera", "depth", "median_depth_m", "valid_depth", "masks")
        values: dict[str, Any] = {name: getattr(self, name) for name in (*names, "truth")}
        return values | {"unread": list(self.unread), "warnings": list(self.warnings)}


def plan_sequence(
    dataset: Dataset,
    indices: Sequence[int] | None = None,
    *,
    pictures: bool = False,
    tracked_masks: bool = True,
) -> SequencePlan:
    """Look at a few frames of ``dataset`` and say what it is taken for.

    A built-in scene is not looked at: it is what it is, and rendering it costs. Nor is one with an attribute
    ``live`` that is true, whose frames come once.

    Args:
        indices: the frames that will be used; None: all.
        pictures: also look at frames that have neither depth nor masks to be checked.
        tracked_masks: whether a mask's id is to mean the same object in every frame.

    Raises:
        DatasetError: its depth cannot be what it is taken for.
    """
    source, camera = source_of(dataset), dataset.camera
    used = list(range(len(dataset)) if indices is None else indices)
    if with_depth := set(_attribute(dataset, "frames_with_depth") or ()):
        used = [i for i in used if i in with_depth] or used
    known = dataset.kind == "synthetic" or is_live(dataset)
    shown = not known and (pictures or dataset.has_depth or dataset.has_masks)
    places = np.linspace(0, len(used) - 1, SAMPLES) if shown else []
    chosen = sorted({used[int(place)] for place in places})
    frames, bad = _looked_at(dataset, chosen)
    images = [frame.depth for frame in frames if frame.depth is not None]
    median, share = depth_statistics(images)
    warnings = list(source.notes)
    if dataset.kind != "synthetic":
        warnings += camera_doubts(camera)
    if images:
        faults = list(depth_faults(images, camera, _attribute(dataset, "depth_scale")))
        for fault in faults:
            if fault.certain:
                raise DatasetError(f"{dataset.name}: {fault.reason}")
        warnings += [fault.reason for fault in faults]
        warnings += [doubt for doubt in _judged(dataset, frames) if doubt]
    warnings += _mask_doubts(dataset, frames, tracked_masks)
    wide, high = field_of_view(camera)
    count = "as they come" if is_live(dataset) else f"{len(dataset)} frames"
    camera_text = (
        f"fx {camera.fx:g} fy {camera.fy:g} cx {camera.cx:g} cy {camera.cy:g} of "
        f"{camera.width}x{camera.height} ({wide:.0f} x {high:.0f} degrees)"
        + (f", from {source.camera}" if source.camera else "")
    )
    return SequencePlan(
        layout=f"{source.layout or dataset.kind}, {count}" + _bad_share(bad, len(chosen)),
        frames=len(dataset),
        pairing=source.pairing,
        camera=camera_text,
        depth=_depth_text(dataset, source.depth_unit, median, share),
        median_depth_m=median,
        valid_depth=share,
        masks=_mask_text(dataset, frames),
        truth=source.truth,
        unread=source.unread,
        warnings=tuple(dict.fromkeys(warnings)),
        looked_at=tuple(frames),
    )


def _attribute(dataset: object, name: str) -> Any:
    """Return what a data set, or one that it wraps, has under ``name``; None: nothing."""
    while dataset is not None and not hasattr(dataset, name):
        dataset = getattr(dataset, "inner", None)
    return getattr(dataset, name, None)


def _looked_at(dataset: Dataset, indices: Sequence[int]) -> tuple[list[Frame], int]:
    """Return those of the frames ``indices`` that can be read, and how many cannot."""
    frames, bad = [], 0
    for index in indices:
        try:
            frames.append(dataset[index])
        except FrameError:
            bad += 1
    return frames, bad


def _judged(dataset: Dataset, frames: Sequence[Frame]) -> tuple[str, str]:
    """Say what is doubtful about the pairing of colour and depth, and about the focal length."""
    pictures = {frame.index: frame.rgb for frame in frames}
    pairs = pairs_around(pictures, len(dataset))
    whole = {index for pair in pairs for index in pair}
    known = {frame.index: frame for frame in frames}
    depth_of = _attribute(dataset, "depth_of") or (lambda index: dataset[index].depth)
    edges: dict[int, NDArray[np.bool_]] = {}
    views: dict[int, View] = {}
    # In rising order: what is packed in a row is read once.
    for index in neighbours(pictures, len(dataset)):
        with contextlib.suppress(FrameError):
            frame = known.get(index) or (dataset[index] if index in whole else None)
            depth = depth_of(index) if frame is None else frame.depth
            if depth is not None:
                edges[index] = edges_of_depth(depth)
                if frame is not None and index in whole:
                    views[index] = view_of(frame)
    return judge(pictures, edges), focal_doubt(views, pairs, dataset.camera)


def _mask_doubts(dataset: Dataset, frames: Sequence[Frame], tracked: bool) -> Iterator[str]:
    mask_of = _attribute(dataset, "mask_of")
    if not dataset.has_masks or mask_of is None:
        return
    pictures = {frame.index: frame.rgb for frame in frames}
    masks = {frame.index: frame.mask for frame in frames}
    masks |= {i: mask_of(i) for i in neighbours(pictures, len(dataset)) if i not in masks}
    yield from mask_doubts(pictures, {i: ids for i, ids in masks.items() if ids is not None}, tracked=tracked)


def _bad_share(bad: int, looked_at: int) -> str:
    return f" ({bad} of {looked_at} looked at cannot be used)" if bad else ""


def _depth_text(dataset: Dataset, unit: str, median: float | None, share: float | None) -> str:
    if not dataset.has_depth:
        return "none"
    parts = [unit] if unit else []
    if median is not None and share is not None:
        parts.append(f"median {median:.3g} m, readings at {100.0 * share:.0f} % of the pixels")
    return "; ".join(parts)


def _mask_text(dataset: Dataset, frames: Sequence[Frame]) -> str:
    if not dataset.has_masks:
        return "none"
    where = _attribute(dataset, "masks_text") or ""
    ids = {int(i) for frame in frames if frame.mask is not None for i in np.unique(frame.mask) if i > 0}
    counted = f"{len(ids)} ids in the frames looked at" if frames else ""
    return "; ".join(part for part in (where, counted) if part)
