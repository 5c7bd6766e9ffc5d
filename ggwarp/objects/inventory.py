# SPDX-License-Identifier: Apache-2.0
"""The list of objects in a map: what ``objects.json`` holds, as frozen dataclasses."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.boxes import (
    Box,
    Extents,
    OrientedBox,
    Vector,
    axis_aligned_box,
    main_parts,
    oriented_box,
)
from ggwarp.io.printable import shown
from ggwarp.map.gaussians import SH_C0
from ggwarp.objects.class_table import NO_OBJECT
from ggwarp.objects.visibility import ObjectVisibility
from ggwarp.types import Float32

_FARTHEST = 1e9
"""Of any number of a record."""
FROM_KEYFRAMES = ("source_ids", "class_name", "label", "first_frame", "last_frame", "views", "confidence")
"""What of a record the map cannot tell."""
_LONGEST_NAME = 1000
"""Characters of a class or label."""


@dataclass(frozen=True)
class ObjectRecord:
    """One object of a map; None = not known.

    Attributes:
        id: as the masks name it; ``object_id`` in the PLY.
        source_ids: the masks' ids that were found to be this object; its own, if no other.
        class_name: what it is, where the data says.
        label: the name a user gave it.
        count: its Gaussians.
        box, oriented_box: trimmed; see :mod:`ggwarp.geometry.boxes`.
        centre: mean of its main parts' Gaussians, metres, world frame; what it turns about.
        colour: mean (red, green, blue), 0..255.
        first_frame, last_frame: the first and last keyframe that show it.
        views: how many keyframes show it.
        confidence: mean probability of its class over its Gaussians.
    """

    id: int
    source_ids: tuple[int, ...]
    class_name: str | None
    label: str | None
    count: int
    box: Box
    oriented_box: OrientedBox
    centre: Vector
    colour: tuple[int, int, int]
    first_frame: int | None = None
    last_frame: int | None = None
    views: int | None = None
    confidence: float | None = None

    @property
    def name(self) -> str:
        """Its label, else its class, else its number."""
        return self.label or self.class_name or f"object {self.id}"

    def to_json(self) -> dict[str, Any]:
        """Return its entry in ``objects.json``; lengths to 0.1 mm."""
        values = dataclasses.asdict(self)
        values["class"] = values.pop("class_name")
        values["box"] = {"min": _rounded(self.box.low), "max": _rounded(self.box.high)}
        values["oriented_box"] = {
            "centre": _rounded(self.oriented_box.centre),
            "quat": _rounded(self.oriented_box.quat, 6),
            "half_sizes": _rounded(self.oriented_box.half_sizes),
        }
        if self.oriented_box.sigmas is not None:
            values["oriented_box"]["sigmas"] = _rounded(self.oriented_box.sigmas)
        values["centre"] = _rounded(self.centre)
        if self.confidence is not None:
            values["confidence"] = round(self.confidence, 4)
        return values

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> ObjectRecord:
        """Return the record of an entry of ``objects.json``.

        Raises:
            ValueError: it is no such entry; says which of its values.
        """
        if not isinstance(entry, dict):
            raise ValueError(f"an object is {shown(entry)}")
        box, oriented = _dict(entry, "box"), _dict(entry, "oriented_box")
        return cls(
            id=_whole(entry, "id", least=1),
            source_ids=tuple(_whole({"source_ids": i}, "source_ids") for i in _list(entry, "source_ids")),
            class_name=_text(entry, "class"),
            label=_text(entry, "label"),
            count=_whole(entry, "count"),
            box=Box(_vector(_numbers(box, "min", 3)), _vector(_numbers(box, "max", 3))),
            oriented_box=OrientedBox(
                _vector(_numbers(oriented, "centre", 3)),
                _quat(_numbers(oriented, "quat", 4)),
                _vector(_numbers(oriented, "half_sizes", 3)),
                None if oriented.get("sigmas") is None else _vector(_numbers(oriented, "sigmas", 3)),
            ),
            centre=_vector(_numbers(entry, "centre", 3)),
            colour=_colour(_numbers(entry, "colour", 3, least=0.0, most=255.0)),
            first_frame=_whole_or_none(entry, "first_frame"),
            last_frame=_whole_or_none(entry, "last_frame"),
            views=_whole_or_none(entry, "views"),
            confidence=None if entry.get("confidence") is None else _number(entry, "confidence"),
        )


def inventory(
    means: Float32,
    colours: Float32,
    object_ids: NDArray[np.integer[Any]] | None,
    *,
    names: dict[int, str] | None = None,
    sources: dict[int, tuple[int, ...]] | None = None,
    visibility: ObjectVisibility | None = None,
    probabilities: Float32 | None = None,
    extents: Extents | None = None,
) -> list[ObjectRecord]:
    """Describe every object of a map.

    Args:
        means: [n, 3] Gaussians' centres, metres, world frame.
        colours: [n, 3] degree-0 spherical harmonics.
        object_ids: [n] ids as the masks name them, 0 = none; None: the map knows no objects.
        names: id -> class name, where the data gives one.
        sources: id -> the masks' ids that became it, where they are not itself alone.
        visibility: what the keyframes showed, by id.
        probabilities: [n] of the class that gave each Gaussian its id.
        extents: how far the Gaussians reach; None: boxes end at their centres.

    Returns:
        One record per object, by id.
    """
    if object_ids is None or len(object_ids) == 0:
        return []
    order = np.argsort(object_ids, kind="stable")
    ids, starts = np.unique(object_ids[order], return_index=True)
    records = []
    for identifier, members in zip(ids.tolist(), np.split(order, starts[1:]), strict=True):
        if identifier == NO_OBJECT:
            continue
        source_ids = (sources or {}).get(identifier, (identifier,))
        seen = visibility.of([identifier]) if visibility is not None else None
        rgb = np.clip(0.5 + SH_C0 * colours[members].mean(0), 0.0, 1.0)
        own = members[main_parts(means[members])]
        body, reach = means[own], None if extents is None else extents.take(own)
        records.append(
            ObjectRecord(
                id=identifier,
                source_ids=source_ids,
                class_name=(names or {}).get(identifier),
                label=None,
                count=len(members),
                box=axis_aligned_box(body, reach),
                oriented_box=oriented_box(body, reach),
                centre=_vector(body.mean(axis=0, dtype=np.float64)),
                colour=_colour(np.rint(255.0 * rgb)),
                first_frame=None if seen is None else seen.first,
                last_frame=None if seen is None else seen.last,
                views=None if seen is None else seen.views,
                confidence=None if probabilities is None else float(probabilities[members].mean()),
            )
        )
    return records


def refreshed(
    records: list[ObjectRecord],
    means: Float32,
    colours: Float32,
    object_ids: NDArray[np.integer[Any]] | None,
    extents: Extents | None = None,
) -> list[ObjectRecord]:
    """Return ``records`` with counts, boxes, centres and colours of an edited map.

    Objects without Gaussians are left out; what the map cannot tell (names, frames, confidence) stays.
    """
    old = {record.id: record for record in records}
    return [
        dataclasses.replace(new, **{name: getattr(old[new.id], name) for name in FROM_KEYFRAMES})
        if new.id in old
        else new
        for new in inventory(means, colours, object_ids, extents=extents)
    ]


def merged_record(records: list[ObjectRecord]) -> ObjectRecord:
    """Return the first of ``records`` with what the keyframes tell of all of them as one.

    Counts, boxes, centre and colour are the map's to tell (:func:`refreshed`). ``views`` is the largest: how
    many keyframes show any of them is not known.
    """
    frames = [r.first_frame for r in records if r.first_frame is not None]
    last = [r.last_frame for r in records if r.last_frame is not None]
    views = [r.views for r in records if r.views is not None]
    known = [(r.confidence, r.count) for r in records if r.confidence is not None]
    weight = sum(count for _, count in known)
    return dataclasses.replace(
        records[0],
        source_ids=tuple(dict.fromkeys(i for r in records for i in r.source_ids)),
        class_name=next((r.class_name for r in records if r.class_name), None),
        label=next((r.label for r in records if r.label), None),
        first_frame=min(frames, default=None),
        last_frame=max(last, default=None),
        views=max(views, default=None),
        confidence=sum(c * n for c, n in known) / weight if weight else None,
    )


def centre_of(means: Float32) -> Vector:
    """Return the mean of the main parts of ``means`` [n, 3], which turns and moves as they do."""
    return _vector(means[main_parts(means)].mean(axis=0, dtype=np.float64))


def is_name(text: str) -> bool:
    """Return whether ``text`` can be the name of an object: short, and of whole characters."""
    return len(text) <= _LONGEST_NAME and not any("\ud800" <= c <= "\udfff" for c in text)


def _value(entry: dict[str, Any], key: str) -> Any:
    if key not in entry:
        raise ValueError(f"{key} is missing")
    return entry[key]


def _dict(entry: dict[str, Any], key: str) -> dict[str, Any]:
    value = _value(entry, key)
    if not isinstance(value, dict):
        raise ValueError(f"{key} is {shown(value)}")
    return value


def _list(entry: dict[str, Any], key: str) -> list[Any]:
    value = _value(entry, key)
    if not isinstance(value, list):
        raise ValueError(f"{key} is {shown(value)}")
    return value


def _whole(entry: dict[str, Any], key: str, *, least: int = 0) -> int:
    value = _value(entry, key)
    if type(value) is not int or not least <= value < 1 << 31:
        raise ValueError(f"{key} is {shown(value)}")
    return value


def _whole_or_none(entry: dict[str, Any], key: str) -> int | None:
    return None if entry.get(key) is None else _whole(entry, key)


def _number(entry: dict[str, Any], key: str, *, least: float = -_FARTHEST, most: float = _FARTHEST) -> float:
    value = _value(entry, key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= most:
        raise ValueError(f"{key} is {shown(value)}")
    return float(value)


def _numbers(
    entry: dict[str, Any], key: str, count: int, *, least: float = -_FARTHEST, most: float = _FARTHEST
) -> list[float]:
    values = _list(entry, key)
    if len(values) != count:
        raise ValueError(f"{key} is {shown(values)}")
    return [_number({key: value}, key, least=least, most=most) for value in values]


def _text(entry: dict[str, Any], key: str) -> str | None:
    value = entry.get(key)
    if value is not None and (not isinstance(value, str) or not is_name(value)):
        raise ValueError(f"{key} is {shown(value)}")
    return value


def _vector(values: Any) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _quat(values: Any) -> tuple[float, float, float, float]:
    w, x, y, z = (float(v) for v in values)
    return w, x, y, z


def _colour(values: Any) -> tuple[int, int, int]:
    r, g, b = (int(v) for v in values)
    return r, g, b


def _rounded(values: tuple[float, ...], digits: int = 4) -> list[float]:
    return [round(v, digits) for v in values]
