# SPDX-License-Identifier: Apache-2.0
"""Folders that something is mounted on: they cannot be renamed."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

_MOUNTS = Path("/proc/self/mountinfo")  # of Linux


def is_mount(folder: Path) -> bool:
    """Return whether something is mounted on ``folder``, be it a folder of the same file system."""
    if os.path.ismount(folder):
        return True
    with contextlib.suppress(OSError, IndexError):
        places = (line.split(" ")[4] for line in _MOUNTS.read_text(errors="surrogateescape").splitlines())
        return os.path.realpath(folder) in map(_unescaped, places)
    return False


def _unescaped(place: str) -> str:
    r"""Return a place as it is named: in the list a blank is ``\040``."""
    return re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), place)
