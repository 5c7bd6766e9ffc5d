# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers in text files, read with errors that name the line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ggwarp.datasets.base import DatasetError
from ggwarp.io import guarded
from ggwarp.io.camera import finite_number
from ggwarp.io.printable import shown


def read_text(path: Path) -> str:
    """Return the text of ``path``.

    Raises:
        DatasetError: the file cannot be read, is no regular file, too large or no text.
    """
    try:
        return guarded.read_text(path, guarded.LIST)
    except guarded.FileError as error:
        raise DatasetError(str(error)) from error


def read_json(path: Path) -> dict[str, Any]:
    """Return the object that the JSON file ``path`` holds.

    Raises:
        DatasetError: the file cannot be read, or holds something else.
    """
    try:
        values = guarded.read_json(path, guarded.LIST)
    except guarded.FileError as error:
        raise DatasetError(str(error)) from error
    if not isinstance(values, dict):
        raise DatasetError(f"{path}: is not a JSON object; copy it again")
    return values


def numbers_of(values: Any, count: int) -> list[float] | None:
    """Return the ``count`` finite numbers of a list, or of a list of rows; None where it is none."""
    if not isinstance(values, list):
        return None
    flat = [x for row in values for x in (row if isinstance(row, list) else [row])]
    found = [number for x in flat if (number := finite_number(x)) is not None]
    return found if len(found) == len(flat) == count else None


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, words) of each line that is neither empty nor a # comment."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if words:
            yield number, words


def parse_float(word: str, path: Path, line: int) -> float:
    """Return the number that ``word`` spells (NaN and inf included).

    Raises:
        DatasetError: it is not a number.
    """
    try:
        return float(word)
    except ValueError:
        raise DatasetError(f"{path}:{line}: {shown(word)} is not a number") from None


def read_numbers(path: Path) -> list[tuple[int, list[float]]]:
    """Return (line number, numbers) of each line of ``path`` that is neither empty nor a comment.

    Raises:
        DatasetError: the file cannot be read, or holds something that is not a number.
    """
    return [(line, [parse_float(word, path, line) for word in words]) for line, words in read_lines(path)]
