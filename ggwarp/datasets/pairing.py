# SPDX-License-Identifier: Apache-2.0
"""Which files belong together: by what varies in their names, by their times, or by their order.

A name is cut into its numbers and what is between them (``rgb_00012_cam0``: 12 and 0). What all names of a
folder have in common says nothing; what varies is compared: as it is, or as a time where no two are equal.
No file is paired twice.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.formats.names import CLOCKS, DECIMAL, WHOLE, columns_of, number_columns, number_pattern
from ggwarp.types import Float64

TIME_TOLERANCE = 0.02
"""Largest time between two images of one frame, seconds: as the TUM benchmark's own tools take it."""

_MOST_CAMERAS = 6
"""That record into one folder."""
_BESIDE = 16
"""Times on either side of one that may be its partners."""
_EPOCH = ((1e9, 1e10, 1.0), (1e12, 1e13, 1e3), (1e15, 1e16, 1e6), (1e18, 1e19, 1e9))
"""(from, to, units a second) of times counted from 1970, in s, ms, us and ns: the years 2001 to 2286."""
_UNITS = {1.0: "s", 1e3: "ms", 1e6: "us", 1e9: "ns"}


@dataclass(frozen=True)
class Pairing:
    """Which of a list's items belong to which of another's.

    Attributes:
        partners: for each item, the index of its partner in the other list; -1: none.
        by: "name", "number", "time" or "order".
        others: length of the other list.
        worst_gap: the largest time between partners, seconds; None: not by time.
        stamps: when each item and each of the others was taken, seconds; None: not by time.
        notes: what is to be said of it, a line each.
    """

    partners: list[int]
    by: str
    others: int
    worst_gap: float | None = None
    stamps: tuple[Float64, Float64] | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def paired(self) -> int:
        """Number of pairs."""
        return sum(partner >= 0 for partner in self.partners)

    def summary(self, item: str, other: str) -> str:
        """Return the pairing in words, such as "by number; 3 of 40 colour images have no depth"."""
        if not self.paired:
            return "none"
        gap = "" if self.worst_gap is None else f", at most {1e3 * self.worst_gap:.1f} ms apart"
        parts = [f"{self.paired} pairs by {self.by}{gap}"]
        for left, name in ((len(self.partners) - self.paired, item), (self.others - self.paired, other)):
            if left:
                parts.append(f"{left} {name} without a partner")
        return "; ".join(parts)


def in_order(paths: Sequence[Path]) -> list[Path]:
    """Return ``paths`` sorted by the numbers in their names, then by the names."""
    pattern = number_pattern([path.stem for path in paths])

    def order(path: Path) -> tuple[list[Decimal], str]:
        return [Decimal(number) for number in pattern.findall(path.stem)], path.name

    return sorted(paths, key=order)


def frame_numbers(paths: Sequence[Path]) -> list[int | None]:
    """Return the whole number that varies in the names of ``paths``, the last if several do; None without.

    A single file's is the last number of its name.
    """
    if len(paths) == 1:
        found = WHOLE.findall(paths[0].stem)
        return [int(found[-1]) if found else None]
    for column in reversed(number_columns([path.stem for path in paths])):
        numbers = [int(v) if isinstance(v, Decimal) and v == int(v) else None for v in column]
        if len(set(column)) == len(column) and sum(n is None for n in numbers) * 2 < len(numbers):
            return numbers
    return [None] * len(paths)


def pair_files(paths: Sequence[Path], others: Sequence[Path], item: str, other: str) -> Pairing:
    """Find for each of ``paths`` the one of ``others`` that belongs to it.

    Args:
        paths, others: of images of one frame each, sorted by :func:`in_order`.
        item, other: what they are, for messages, such as "colour images" and "depth images".

    Raises:
        DatasetError: the names do not tell which belong together.
    """
    names, other_names = [p.stem for p in paths], [p.stem for p in others]
    if not names or not other_names:
        return Pairing([-1] * len(names), "name", len(other_names))
    found = [("name", _equal(names, other_names))]
    found += [("number", partners) for partners in _by_numbers(names, other_names)]
    usable = [(by, partners) for by, partners in found if partners is not None]
    by, best = max(usable, key=lambda choice: _count(choice[1]), default=("", []))
    most = min(len(names), len(other_names))
    if _count(best) < most and (timed := _by_time(names, other_names)) and timed.paired > _count(best):
        return timed
    if _count(best):
        return _checked(Pairing(best, by, len(others)), paths, others, item, other)
    unique = all(len(set(keys)) == len(keys) for keys in (names, other_names)) and len(found) > 1
    reason = "no two have the same name, number or time" if unique else "several have the same number"
    raise DatasetError(
        f"{others[0].parent}: the names do not tell which {other} belong to which {item} "
        f"({others[0].name}, ... and {paths[0].name}, ...): {reason}; give both the same numbers"
    )


def several_cameras(paths: Sequence[Path]) -> str:
    """Say so where the names of ``paths`` are every number with each of a few variants; empty: not so."""
    columns = columns_of([path.stem for path in paths])
    for place, column in enumerate(columns):
        variants = set(column)
        rest = set(zip(*columns[:place], *columns[place + 1 :], strict=True))
        if 2 <= len(variants) <= _MOST_CAMERAS < len(rest) and len(rest) * len(variants) == len(paths):
            other = paths[next(i for i, value in enumerate(column) if value != column[0])]
            return (
                f"each image is there {len(variants)} times ({paths[0].name}, {other.name}): by several "
                "cameras? All are taken for one camera's; move each one's into a folder of its own"
            )
    return ""


def pair_times(stamps: Float64, others: Float64, *, tolerance: float = TIME_TOLERANCE) -> Pairing:
    """Pair the times ``stamps`` [n] with the nearest of ``others`` [m], seconds; each is taken once at most.

    The nearest pairs are made first; what has lost its nearest partner to a nearer one may take another.
    """
    partners = np.full(len(stamps), -1)
    gap = np.zeros(len(stamps))
    if len(others) and len(stamps):
        order = np.argsort(others, kind="stable")
        place = np.searchsorted(others[order], stamps)[:, None] + np.arange(-_BESIDE, _BESIDE)
        inside = (place >= 0) & (place < len(others))
        index = order[place.clip(0, len(others) - 1)]
        gaps = np.where(inside, np.abs(others[index] - stamps[:, None]), np.inf)
        taken: set[int] = set()
        for flat in np.argsort(gaps, axis=None, kind="stable").tolist():
            row, column = divmod(flat, 2 * _BESIDE)
            if gaps[row, column] > tolerance:
                break
            other = int(index[row, column])
            if partners[row] < 0 and other not in taken:
                partners[row], gap[row] = other, gaps[row, column]
                taken.add(other)
    paired = partners >= 0
    worst = float(gap[paired].max()) if paired.any() else None
    return Pairing(partners.tolist(), "time", len(others), worst, (stamps, others))


def unit_of_times(times: Sequence[Decimal] | Float64) -> float | None:
    """Return how many units of ``times`` make a second (1, 1e3, 1e6 or 1e9); None where they do not tell.

    Times since 1970 tell by their size, others by decimals, which seconds alone are written with.
    """
    values = np.array([float(time) for time in times])
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    middle = float(np.median(values))
    for low, high, unit in _EPOCH:
        if low <= middle < high:
            return unit
    return 1.0 if (values != np.trunc(values)).any() else None


def unit_name(units_a_second: float) -> str:
    """Return the name of a unit of time: s, ms, us or ns."""
    return _UNITS[units_a_second]


def _count(partners: list[int]) -> int:
    return sum(partner >= 0 for partner in partners)


def _equal(keys: Sequence[object], others: Sequence[object]) -> list[int] | None:
    """Return the partners of equal keys; None where a list has a key twice."""
    place = {key: index for index, key in enumerate(others)}
    if len(place) < len(others) or len(set(keys)) < len(keys):
        return None
    return [place.get(key, -1) for key in keys]


def _by_numbers(names: Sequence[str], others: Sequence[str]) -> list[list[int] | None]:
    """Return the partners by all that varies in the names, and by each number that does."""
    if len(names) == 1 or len(others) == 1:  # nothing varies: the last number is it
        return [_equal([_last_number(n) for n in names], [_last_number(n) for n in others])]
    mine, theirs = columns_of(names), columns_of(others)
    found = []
    if mine and theirs:
        found.append(_equal(list(zip(*mine, strict=True)), list(zip(*theirs, strict=True))))
    mine, theirs = number_columns(names), number_columns(others)
    if len(mine) == len(theirs):
        pairs = list(zip(mine, theirs, strict=True))
    else:
        pairs = [(one, other) for one in mine for other in theirs]
    return found + [_equal(one, other) for one, other in pairs]


def _last_number(name: str) -> object:
    numbers = DECIMAL.findall(name)
    return Decimal(numbers[-1]) if numbers else name


def _by_time(names: Sequence[str], others: Sequence[str]) -> Pairing | None:
    """Pair by times in the names of both lists; None where there are none such or no pairs."""
    for read in CLOCKS:
        for mine, theirs in itertools.product(read(names), read(others)):
            times = [*mine, *theirs]
            unit = unit_of_times(times)
            # What does not rise from name to name is the lower part of a time, such as its seconds.
            if unit is None or any(list(c) != sorted(c) for c in (mine, theirs)):
                continue
            first = min(times)  # nanoseconds since 1970 have more digits than a float
            stamps = np.array([float(time - first) / unit for time in times])
            pairing = pair_times(stamps[: len(mine)], stamps[len(mine) :])
            if pairing.paired:
                return pairing
    return None


def _checked(
    pairing: Pairing, paths: Sequence[Path], others: Sequence[Path], item: str, other: str
) -> Pairing:
    """Return ``pairing``, or that by order where both lists count without gaps from different numbers.

    As many of both, off by one, are more likely two ways of counting than a frame missing at either end.
    """
    numbers = [frame_numbers(list(files)) for files in (paths, others)]
    if any(n is None for ns in numbers for n in ns) or len(paths) < 2 or len(others) < 2:
        return pairing
    mine, theirs = ([int(n) for n in ns if n is not None] for ns in numbers)
    step, other_step = ({b - a for a, b in itertools.pairwise(ns)} for ns in (sorted(mine), sorted(theirs)))
    if len(step) != 1 or len(other_step) != 1:
        return pairing
    if pairing.paired < len(mine) == len(theirs) and step == other_step:
        note = (
            f"the numbers of {item} and {other} differ by {abs(min(mine) - min(theirs))} ({paths[0].name}, "
            f"{others[0].name}) though there are {len(mine)} of each: paired in their order"
        )
        return Pairing(list(range(len(mine))), "order", len(others), notes=[note])
    fewer, more = sorted((len(mine), len(theirs)))
    if min(mine) == min(theirs) and step == other_step and fewer <= 0.75 * more:
        note = (
            f"{len(mine)} {item} and {len(theirs)} {other}, both numbered from {min(mine)} without gaps: "
            "equal numbers are paired, which is wrong where the two came at different rates; then name both "
            "by their frame or time"
        )
        return replace(pairing, notes=[note])
    return pairing
