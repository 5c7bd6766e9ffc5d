# SPDX-License-Identifier: Apache-2.0
"""Folders that are locked while the program that made them lives."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path


def lock_folder(folder: Path) -> int | None:
    """Return a file descriptor that holds ``folder`` locked; None where the system cannot.

    Raises:
        OSError: another program holds it.
    """
    try:
        import fcntl
    except ImportError:
        return None
    file: int | None = None
    try:
        file = os.open(folder, os.O_RDONLY)
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if file is not None:
            os.close(file)
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise
        return None
    return file


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Hold the file ``path``, made where it is not there, for this program alone; wait for another one.

    Where the system knows no locks, nothing is waited for.

    Raises:
        OSError: the file cannot be made.
    """
    with path.open("a") as file:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def in_use(folder: Path) -> bool:
    """Return whether the program that locked ``folder`` lives; without locks, the one whose id it bears."""
    try:
        file = lock_folder(folder)
    except OSError:
        return True
    if file is not None:
        os.close(file)
        return False
    number = re.search(r"(?:partial|old)-(\d+)", folder.name)
    return number is not None and _alive(int(number[1]))


def _alive(pid: int) -> bool:
    if sys.platform == "win32":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
