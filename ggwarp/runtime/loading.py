# SPDX-License-Identifier: Apache-2.0
"""Compiling and loading kernels ahead of their first launch.

Warp compiles a module when one of its kernels is first launched, one module after another. Doing it
beforehand uses all cores, can be announced, and keeps threads from compiling at once.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import pkgutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import warp as wp

ONE_DEVICE = {
    "raster.composite_cpu": "cpu",
    "raster.composite_cpu_adjoint": "cpu",
    "raster.composite_cuda": "cuda",
    "identity.cross_entropy_pixels": "cuda",
    "losses.rgbd_rows": "cpu",
    "raster.tiles_parallel": "cuda",
}
"""Modules whose kernels run on one kind of device only."""


_PATIENCE = 4.0
"""Seconds that modules in hand may take to compile when the loading is interrupted."""


class ArchitectureError(ValueError):
    """A CUDA architecture that Warp cannot compile for."""


def all_kernel_modules() -> list[Any]:
    """Import the kernels' modules and return the Warp modules that hold kernels, by name."""
    return _imported(_names())


def kernel_modules(device: Any) -> list[Any]:
    """Import the kernels' modules and return the Warp modules that ``device`` runs."""
    return _imported(_names(_kind(device)))


def imported_kernel_modules(device: Any) -> list[Any]:
    """Return the Warp modules with kernels, among those imported so far, that ``device`` runs."""
    return _with_kernels(n for n in _names(_kind(device)) if n in sys.modules)


def _kind(device: Any) -> str:
    return "cpu" if wp.get_device(device).is_cpu else "cuda"


def _names(kind: str | None = None) -> list[str]:
    """Return the names of the kernels' modules; with ``kind``, of those that such a device runs."""
    spec = importlib.util.find_spec("ggwarp.kernels")
    assert spec is not None
    modules = pkgutil.walk_packages(spec.submodule_search_locations, "ggwarp.kernels.")
    found = (m.name for m in modules if not m.ispkg)
    return sorted(n for n in found if kind in (None, ONE_DEVICE.get(n.removeprefix("ggwarp.kernels."), kind)))


def _imported(names: Iterable[str]) -> list[Any]:
    return _with_kernels(importlib.import_module(name).__name__ for name in names)


def _with_kernels(names: Iterable[str]) -> list[Any]:
    return [m for m in map(wp.get_module, names) if m.kernels]


def uncompiled(modules: list[Any], device: Any) -> list[Any]:
    """Return those of ``modules`` that Warp's cache does not hold for ``device``."""
    wp.init()
    device = wp.get_device(device)
    # The block size is part of a module's identity; on a CPU a block is one thread.
    block_dim, ending = 1, ".o"
    if device.is_cuda:
        block_dim, ending = None, f".sm{device.get_cuda_compile_arch()}.{device.get_cuda_output_format()}"
    return [m for m in modules if not _cached(m, ending, block_dim)]


def _cached(module: Any, ending: str, block_dim: int | None = None) -> bool:
    folder = Path(str(wp.config.kernel_cache_dir)) / module.get_module_identifier(block_dim)
    return any(path.name.endswith(ending) for path in folder.glob("*"))


def compile_for(arch: int) -> tuple[int, int]:
    """Compile all modules for CUDA architecture ``arch`` into Warp's cache, on all cores.

    Returns:
        How many were compiled, and how many were there.

    Raises:
        ArchitectureError: Warp's compiler does not know ``arch``.
    """
    wp.init()
    modules = _imported(_names("cuda"))
    cold = [m for m in modules if not _cached(m, f".sm{arch}.cubin")]

    def build(module: Any) -> None:
        wp.compile_aot_module(module, arch=arch, use_ptx=False)

    if cold:
        try:
            build(cold[0])
        except Exception as error:
            raise ArchitectureError(
                f"architecture {arch}: {error}; give compute capabilities such as 90"
            ) from error
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(build, cold[1:]))
    return len(cold), len(modules) - len(cold)


def load(modules: list[Any], device: Any) -> None:
    """Load ``modules`` on ``device``, compiling what is not in the cache, on all cores.

    When it is interrupted no module is begun any more, and those in hand are waited for a while: a compiler
    that works on while the program ends may crash it.
    """
    waiting, ended, errors = list(reversed(modules)), threading.Event(), list[BaseException]()

    def work() -> None:
        with contextlib.suppress(IndexError):  # none is left
            while not ended.is_set():
                module = waiting.pop()
                try:
                    wp.force_load(device=device, modules=[module], max_workers=0)
                except BaseException as error:
                    errors.append(error)
                    ended.set()

    count = min(os.cpu_count() or 1, len(modules))
    # Daemons, not a pool: the program would wait for a pool's whole queue before it ends.
    threads = [threading.Thread(target=work, name="ggwarp-load", daemon=True) for _ in range(count)]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            thread.join()
    except BaseException:
        ended.set()
        deadline = time.monotonic() + _PATIENCE
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        raise
    if errors:
        raise errors[0]


def init_quietly() -> None:
    """Start Warp without its greeting, and without its warning where there is no NVIDIA driver.

    Warp shall compile for the very device: its own choice depends on the driver, and may miss what was
    compiled beforehand.
    """
    wp.config.log_level = wp.LOG_WARNING
    wp.config.cuda_output = wp.config.cuda_output or "cubin"
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
    for device in wp.get_cuda_devices():
        if wp.is_mempool_enabled(device):
            # Else every wait gives unused memory back to the driver, and the next frame asks for it again.
            wp.set_mempool_release_threshold(device, 0.5)
    for line in lines:
        if "Could not find or load the NVIDIA CUDA driver" not in line:
            print(line, file=sys.stderr)
