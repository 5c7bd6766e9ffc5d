# SPDX-License-Identifier: Apache-2.0
"""Tables as CSV files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ggwarp.io.atomic import atomic_write
from ggwarp.io.guarded import TABLE, FileError, read_text
from ggwarp.io.printable import printable


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write ``rows`` under ``columns``; what is missing, None or not finite becomes an empty cell.

    Raises:
        ValueError: a row has a value for none of the columns.
        OSError: the file cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, restval="")
    writer.writeheader()
    writer.writerows({k: _cell(v) for k, v in row.items()} for row in rows)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def read_table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table by column; an empty cell is an empty text.

    Raises:
        FileError: the file cannot be read, or a row has more or fewer cells than there are columns.
    """
    reader = csv.DictReader(io.StringIO(read_text(path, TABLE), newline=""), strict=True)
    try:
        rows = list(reader)
    except csv.Error as error:
        raise FileError(f"{printable(str(path))}:{reader.line_num}: {error}") from None
    for number, row in enumerate(rows, 2):
        if None in row or None in row.values():
            raise FileError(f"{printable(str(path))}:{number}: has not as many cells as there are columns")
    return rows


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.6f}" if math.isfinite(value) else ""
    return "" if value is None else value
