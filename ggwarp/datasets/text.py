# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers in text files, read with errors that name the line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ggwarp.datasets.base import DatasetError


def read_text(path: Path) -> str:
    """Return the text of ``path``.

    Raises:
        DatasetError: the file cannot be read or is not text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: is not a text file") from error


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
        raise DatasetError(f"{path}:{line}: {word!r} is not a number") from None


def read_numbers(path: Path) -> list[tuple[int, list[float]]]:
    """Return (line number, numbers) of each line of ``path`` that is neither empty nor a comment.

    Raises:
        DatasetError: the file cannot be read, or holds something that is not a number.
    """
    return [(line, [parse_float(word, path, line) for word in words]) for line, words in read_lines(path)]
