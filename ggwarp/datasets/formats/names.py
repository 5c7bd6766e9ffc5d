# SPDX-License-Identifier: Apache-2.0
"""What the names of a folder's files say: the numbers that vary in them, and the times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime, timezone
from decimal import Decimal

DECIMAL = re.compile(r"\d+(?:\.\d+)?")
WHOLE = re.compile(r"\d+")
_DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_.T ]?"  # the day
    r"(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)(?:[-_.](\d{1,9}))?(?!\d)"  # its time, and a fraction
)
_FRACTION = re.compile(r"(?<!\d)(\d+)[-_](\d{9}|\d{6}|\d{3})(?!\d)")


def number_pattern(names: Sequence[str]) -> re.Pattern[str]:
    """Return what a number looks like in ``names``: with decimals, unless these count (1.9, 1.10)."""
    parts: dict[int, list[tuple[str, str]]] = {}
    for name in names:
        for position, number in enumerate(DECIMAL.findall(name)):
            whole, point, decimals = number.partition(".")
            if point:
                parts.setdefault(position, []).append((whole, decimals))
    for pairs in parts.values():
        wholes, widths = {whole for whole, _ in pairs}, {len(decimals) for _, decimals in pairs}
        if len(pairs) > 1 and len(wholes) == 1 and len(widths) > 1:
            return WHOLE
    return DECIMAL


def columns_of(names: Sequence[str]) -> list[tuple[Decimal | str, ...]]:
    """Return what varies in ``names``, a column of values each; numbers as numbers.

    Most names are of one make: those with another count of numbers stand for themselves in every column.
    """
    if not names:
        return []
    pattern = number_pattern(names)
    numbers = [pattern.findall(name) for name in names]
    counts = [len(found) for found in numbers]
    usual = max(set(counts), key=counts.count)
    columns: list[list[Decimal | str]] = [[] for _ in range(2 * usual + 1)]
    for name, found in zip(names, numbers, strict=True):
        parts: list[Decimal | str] = [name] * (2 * usual + 1)
        if len(found) == usual:
            parts[0::2] = pattern.split(name)
            parts[1::2] = map(Decimal, found)
        for column, part in zip(columns, parts, strict=True):
            column.append(part)
    return [tuple(column) for column in columns if len(set(column)) > 1]


def number_columns(names: Sequence[str]) -> list[tuple[Decimal | str, ...]]:
    """Return those of :func:`columns_of` that are mostly numbers."""
    return [c for c in columns_of(names) if sum(isinstance(v, Decimal) for v in c) * 2 > len(c)]


def _calendar(names: Sequence[str]) -> list[list[Decimal]]:
    """Return the seconds since 1970 of names like 2024-01-05_15-30-00.123; none where one is no such name."""
    times = []
    for name in names:
        found = _DATE.search(name)
        if found is None:
            return []
        try:
            date = datetime(*map(int, found.groups()[:6]), tzinfo=timezone.utc)  # pyright: ignore[reportArgumentType]
        except ValueError:
            return []
        times.append(Decimal(int(date.timestamp())) + Decimal(f"0.{found[7] or 0}"))
    return [times]


def _seconds_and_fraction(names: Sequence[str]) -> list[list[Decimal]]:
    """Return the times of names like 1700000000_123456789: seconds, and 3, 6 or 9 digits of a fraction."""
    found = [_FRACTION.search(name) for name in names]
    return [[Decimal(f"{match[1]}.{match[2]}") for match in found if match]] if all(found) else []


def _single_numbers(names: Sequence[str]) -> list[list[Decimal]]:
    """Return the columns of numbers that vary, the last first."""
    columns = [[v for v in column if isinstance(v, Decimal)] for column in reversed(number_columns(names))]
    return [column for column in columns if len(column) == len(names)]


CLOCKS = (_calendar, _seconds_and_fraction, _single_numbers)
