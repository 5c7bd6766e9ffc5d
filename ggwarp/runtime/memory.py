# SPDX-License-Identifier: Apache-2.0
"""How much memory there is."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

import warp as wp

_UNKNOWN = 4 << 30
"""Bytes that a machine is taken to have which does not say."""

_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Where a container says what it may have, by cgroups 2 and 1."""


def machine_memory(limits: tuple[str, ...] = _LIMITS) -> int:
    """Return the bytes of memory of this machine, or that a container may have of them."""
    known = []
    with contextlib.suppress(AttributeError, ValueError, OSError):
        known.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for path in limits:
        with contextlib.suppress(OSError, ValueError):
            known.append(int(Path(path).read_text()))  # "max" without a limit
    return min((value for value in known if value > 0), default=_UNKNOWN)


def image_budget(device: Any, gigabytes: float | None) -> int:
    """Return how many bytes a run's images may take on ``device``.

    Args:
        gigabytes: as asked for; None: a third of what the machine has, and the device.
    """
    if gigabytes is not None:
        return round(gigabytes * 1e9)
    found, total = wp.get_device(device), machine_memory()
    return (min(total, found.total_memory) if found.is_cuda else total) // 3
