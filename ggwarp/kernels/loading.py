# SPDX-License-Identifier: Apache-2.0
"""Compiling and loading kernels ahead of their first launch.

Warp compiles a module when one of its kernels is first launched, one module after another. Doing it
beforehand uses all cores, can be announced, and keeps threads from compiling at once.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import warp as wp

import ggwarp.kernels

ONE_DEVICE = {
    "composite_cpu": "cpu",
    "composite_cpu_adjoint": "cpu",
    "composite_cuda": "cuda",
    "identity_pixels": "cuda",
    "tiles_parallel": "cuda",
}
"""Modules whose kernels run on one kind of device only."""


def all_kernel_modules() -> list[Any]:
    """Import this package's modules and return the Warp modules that hold kernels, by name."""
    return _with_kernels(importlib.import_module(name).__name__ for name in _names())


def imported_kernel_modules(device: Any) -> list[Any]:
    """Return the Warp modules with kernels, among those imported so far, that ``device`` runs."""
    kind = "cpu" if wp.get_device(device).is_cpu else "cuda"
    names = (n for n in _names() if ONE_DEVICE.get(n.rsplit(".", 1)[-1], kind) == kind)
    return _with_kernels(n for n in names if n in sys.modules)


def _names() -> list[str]:
    found = (m.name for m in pkgutil.iter_modules(ggwarp.kernels.__path__))
    return sorted(f"ggwarp.kernels.{name}" for name in found)


def _with_kernels(names: Iterable[str]) -> list[Any]:
    return [m for m in map(wp.get_module, names) if m.kernels]


def uncompiled(modules: list[Any], device: Any) -> list[Any]:
    """Return those of ``modules`` that Warp's cache does not hold for ``device``."""
    wp.init()
    # The block size is part of a module's identity; on a CPU a block is one thread.
    block_dim, suffixes = (1, (".o",)) if wp.get_device(device).is_cpu else (None, (".cubin", ".ptx"))
    missing = []
    for module in modules:
        folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim)
        if not any(path.suffix in suffixes for path in folder.glob("*")):
            missing.append(module)
    return missing


def load(modules: list[Any], device: Any) -> None:
    """Load ``modules`` on ``device``, compiling what is not in the cache, on all cores."""
    if modules:
        wp.force_load(device=device, modules=modules, max_workers=os.cpu_count() or 1)


def init_quietly() -> None:
    """Start Warp without its greeting, and without its warning where there is no NVIDIA driver."""
    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as said:
        # The warning comes from native code: only the file descriptor can hold it back.
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        said.seek(0)
        lines = said.read().decode(errors="replace").splitlines()
    for line in lines:
        if "Could not find or load the NVIDIA CUDA driver" not in line:
            print(line, file=sys.stderr)
