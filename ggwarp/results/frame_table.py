# SPDX-License-Identifier: Apache-2.0
"""``frames.csv`` and its like read back."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

from ggwarp.io.guarded import LIST, FileError, open_file
from ggwarp.io.printable import printable

SKIPPED = "skipped"
"""The verdict of a frame that could not be used; the trajectory has no row of it."""


class FrameTable:
    """A run's table of frames.

    Attributes:
        rows: one a frame, column -> text; empty = not measured.
    """

    def __init__(self, rows: list[dict[str, str]]) -> None:
        """Take ``rows`` as they are."""
        self.rows = rows

    def __len__(self) -> int:
        return len(self.rows)

    def tracked(self) -> FrameTable:
        """Return the rows that the trajectory has, in its order."""
        return FrameTable([row for row in self.rows if row.get("verdict") != SKIPPED])

    def text(self, column: str) -> list[str]:
        """Return a column as it is."""
        return [row.get(column) or "" for row in self.rows]

    def numbers(self, column: str) -> list[float]:
        """Return a column as numbers; nan where there is none."""
        return [_number(text) for text in self.text(column)]

    def indices(self) -> list[int]:
        """Return the frames' indices in the sequence; -1 where there is none."""
        return [int(value) if math.isfinite(value) else -1 for value in self.numbers("index")]


def read_frames(folder: Path, name: str = "frames.csv") -> FrameTable:
    """Read the table ``name`` of the run in ``folder``; no rows where there is none.

    Raises:
        FileError: it cannot be read.
    """
    path = folder / name
    if not path.is_file():
        return FrameTable([])
    with open_file(path, LIST) as file:
        try:
            text = file.read().decode("utf-8")
        except UnicodeDecodeError:
            raise FileError(f"{printable(str(path))}: is no table of frames: it is not UTF-8") from None
    rows = csv.DictReader(io.StringIO(text, newline=""))
    return FrameTable([{str(k): str(v) for k, v in row.items() if v is not None} for row in rows])


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan
