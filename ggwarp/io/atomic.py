# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

_FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}


class _Counted:
    """Counts the bytes that a file is to hold, also those that it has no room for."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.size = file, 0

    def write(self, data: bytes) -> int:
        self.size += len(data)
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


@contextmanager
def atomic_write(path: str | Path) -> Iterator[BinaryIO]:
    """Open ``path`` for writing bytes; it replaces what was there once the block has succeeded.

    The bytes are on the disk before the name is: a power cut leaves the old file or the new one, never half.

    Raises:
        OSError: the folder is missing, the disk is full, ...; it names ``path``, which is then as it was.
            Of a full disk it says what is needed and what is free.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    counted: _Counted | None = None
    try:
        with open(part, "wb") as file:
            counted = _Counted(file)
            yield cast(BinaryIO, counted)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        if error.errno in _FULL:
            part.unlink(missing_ok=True)  # else it counts against what is free
            error.strerror = f"{error.strerror}{_room(path.parent, counted.size if counted else 0)}"
        if error.filename is None or os.fspath(error.filename) == str(part):
            error.filename = str(path)  # a full disk gives none
            error.filename2 = None
        raise
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _room(folder: Path, needed: int) -> str:
    """Return what a full disk lacks, in parentheses; empty where the system does not say."""
    try:
        inodes = os.statvfs(folder)
        if inodes.f_files and not inodes.f_favail:
            return " (it takes no more files, whatever their size)"
        free = shutil.disk_usage(folder).free
    except (OSError, AttributeError):
        return ""
    return "" if not needed else f" ({needed / 1e6:.2f} MB needed, {free / 1e6:.2f} MB free)"
