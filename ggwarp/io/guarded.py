# SPDX-License-Identifier: Apache-2.0
"""The one way to read a file that somebody else wrote.

Only regular files are opened (or links to them): never a pipe, a device or a folder, which would wait for
ever or never end. Every kind of file has a size that it cannot sensibly exceed; more than that is never read.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ggwarp.io.printable import shown_path

_MIB = 1 << 20


class FileError(ValueError):
    """A file cannot be read as what it should be: one line with the file, what is wrong and the remedy."""


class FileKind(NamedTuple):
    """A kind of file.

    Attributes:
        name: with its article, for messages.
        limit: the most bytes that such a file may have.
    """

    name: str
    limit: int


IMAGE = FileKind("an image", 256 * _MIB)
LIST = FileKind("a list of numbers or names", 32 * _MIB)
CAMERA = FileKind("a camera file", 64 << 10)
CONFIG = FileKind("a configuration", _MIB)
OBJECTS = FileKind("a list of objects", 16 * _MIB)
CLASSIFIER = FileKind("an identity classifier", 8 * _MIB)
TRAJECTORY = FileKind("a trajectory", 256 * _MIB)
TABLE = FileKind("a table", 256 * _MIB)
MAP = FileKind("a map", 8 << 30)
VIDEO = FileKind("a video", 1 << 50)

_SPECIAL = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)


def check_file(path: str | Path, kind: FileKind) -> int:
    """Return the size of ``path`` in bytes, having looked at what it is without opening it.

    Raises:
        FileError: it is missing, no regular file, or larger than ``kind`` allows.
    """
    name = shown_path(path)
    try:
        status = os.stat(path)
    except OSError as error:
        raise FileError(f"{name}: cannot be read ({error.strerror})") from None
    except ValueError:  # a NUL, or a character that the file system has no bytes for
        raise FileError(f"{name}: no file can have this name") from None
    if not stat.S_ISREG(status.st_mode):
        what = next((text for test, text in _SPECIAL if test(status.st_mode)), "something else")
        raise FileError(f"{name}: is {what}, where {kind.name} should be")
    if status.st_size > kind.limit:
        raise FileError(f"{name}: has {status.st_size:,} bytes; {kind.name} has at most {kind.limit:,}")
    return status.st_size


@contextmanager
def open_file(path: str | Path, kind: FileKind) -> Iterator[BinaryIO]:
    """Open ``path`` for reading bytes once :func:`check_file` has passed it.

    Raises:
        FileError: as there, or it cannot be opened or read.
    """
    check_file(path, kind)
    try:
        with open(path, "rb") as file:
            yield file
    except OSError as error:
        raise FileError(f"{shown_path(path)}: cannot be read ({error.strerror or error})") from error


def read_bytes(path: str | Path, kind: FileKind) -> bytes:
    """Return the whole of ``path``.

    Raises:
        FileError: see :func:`open_file`.
    """
    with open_file(path, kind) as file:
        data = file.read(kind.limit + 1)
    if len(data) > kind.limit:  # some files of the system claim to be empty
        raise FileError(f"{shown_path(path)}: never ends; {kind.name} has at most {kind.limit:,} bytes")
    return data


def read_text(path: str | Path, kind: FileKind) -> str:
    """Return the text of ``path``, which is UTF-8 with or without its mark.

    Raises:
        FileError: see :func:`open_file`; or it is not text.
    """
    try:
        return read_bytes(path, kind).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FileError(f"{shown_path(path)}: is not a text file (UTF-8)") from None


def read_json(path: str | Path, kind: FileKind) -> Any:
    """Return what the JSON file ``path`` holds.

    Raises:
        FileError: see :func:`read_text`; or it is not JSON, is nested without end, or holds a number of
            thousands of digits.
    """
    text = read_text(path, kind)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise FileError(f"{shown_path(path)}:{error.lineno}: is not JSON ({error.msg})") from None
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else "a number is too long"
        raise FileError(f"{shown_path(path)}: is not JSON that can be read ({reason})") from None


def inside(folder: Path, path: Path) -> Path:
    """Return ``path``, which a list in ``folder`` names, having checked that it lies there.

    A link in the folder may lead anywhere, since its owner made it; a name in a list may not.

    Raises:
        FileError: ``path`` leads out of ``folder``.
    """
    for top in (folder, folder.absolute()):
        if path.is_relative_to(top) and ".." not in path.relative_to(top).parts:
            return path
    raise FileError(
        f"{shown_path(path)}: lies outside {shown_path(folder)}; copy it there, or make a link there"
    )
