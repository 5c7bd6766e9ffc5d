# SPDX-License-Identifier: Apache-2.0
"""Compiling and loading kernels ahead of their first launch.

Warp compiles a module when one of its kernels is first launched, one module after another. Doing it
beforehand uses all cores, can be announced, and keeps threads from compiling at once.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import logging
import os
import pkgutil
import re
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from ggwarp.runtime import kernel_cache

_log = logging.getLogger(__name__)

ONE_DEVICE = {
    "raster.composite_cpu": "cpu",
    "raster.composite_cpu_adjoint": "cpu",
    "raster.composite_cuda": "cuda",
    "raster.composite_cuda_adjoint": "cuda",
    "identity.cross_entropy_pixels": "cuda",
    "losses.rgbd_rows": "cpu",
    "losses.ssim": "cpu",
    "losses.ssim_planes": "cuda",
    "raster.tiles_parallel": "cuda",
}
"""Modules whose kernels run on one kind of device only."""


_PATIENCE = 4.0
"""Seconds that modules in hand may take to compile when the loading is interrupted."""

_COMPILER_OPTIONS = ("optimization_level", "cpu_compiler_flags")

_ATTEMPTS = 3
"""From the cache, compiled anew, compiled into another folder."""

_LOOK_UP = re.compile("Failed to lookup symbol")  # what follows says which kernel, or mends it
_HEADERS = re.compile(r"\.pch'|precompiled headers|^\d+ errors? generated")


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
    """Return those of ``modules`` that Warp's cache does not hold for ``device``, or holds damaged."""
    wp.init()
    device = wp.get_device(device)
    ending = ".o"
    if device.is_cuda:
        ending = f".sm{device.get_cuda_compile_arch()}.{device.get_cuda_output_format()}"
    return [m for m in modules if not _cached(m, ending, _block_dim(device))]


def _block_dim(device: Any) -> int | None:
    """Return the block size that is part of a module's identity; on a CPU a block is one thread."""
    return 1 if wp.get_device(device).is_cpu else None


def _cached(module: Any, ending: str, block_dim: int | None = None) -> bool:
    found = kernel_cache.binaries(kernel_cache.folder_of(module, block_dim), ending)
    return bool(found) and all(map(kernel_cache.is_sound, found))


def compile_for(arch: int) -> tuple[int, int]:
    """Compile all modules for CUDA architecture ``arch`` into Warp's cache, on all cores.

    Returns:
        How many were compiled, and how many were there.

    Raises:
        ArchitectureError: Warp's compiler does not know ``arch``.
        OSError: there is no room in the cache.
    """
    wp.init()
    modules = _imported(_names("cuda"))
    cold = [m for m in modules if not _cached(m, f".sm{arch}.cubin")]

    _remove_damaged(cold, None)

    def build(module: Any) -> None:
        wp.compile_aot_module(module, arch=arch, use_ptx=False)
        kernel_cache.seal(kernel_cache.folder_of(module))

    if cold:
        try:
            build(cold[0])
        except Exception as error:
            if full := kernel_cache.why_not_writable():
                raise kernel_cache.no_room(full) from error
            raise ArchitectureError(
                f"architecture {arch}: {error}; give compute capabilities such as 90"
            ) from error
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(build, cold[1:]))
    return len(cold), len(modules) - len(cold)


def load(modules: list[Any], device: Any) -> None:
    """Load ``modules`` on ``device``, compiling what is not in the cache or is damaged there, on all cores.

    A cache that cannot be written to is replaced by a temporary one for as long as the program runs.

    When it is interrupted no module is begun any more, and those in hand are waited for a while: a compiler
    that works on while the program ends may crash it.

    Raises:
        OSError: there is no place for what must be compiled.
    """
    # Each thread's compiler reads Warp's headers once for each set of options, which takes longer than most
    # modules: threads take modules from both ends.
    cold = sorted(uncompiled(modules, device), key=_options)
    with _compiler_s_words():
        # What is there first: to compile the others the cache may have to be left.
        _load_all([m for m in modules if m not in cold], device)
        cache = str(wp.config.kernel_cache_dir)
        try:
            _remove_damaged(cold, _block_dim(device))
        except OSError as error:
            kernel_cache.use_temporary(cache, error)
        for _ in range(2):  # the cache, and the temporary one
            if full := kernel_cache.why_not_writable(len(cold)) if cold else None:
                kernel_cache.use_temporary(str(wp.config.kernel_cache_dir), full)
        _load_all(cold, device)


def _options(module: Any) -> str:
    return repr([module.options.get(name) for name in _COMPILER_OPTIONS])


def _remove_damaged(modules: list[Any], block_dim: int | None) -> None:
    found = [m for m in modules if kernel_cache.is_damaged(kernel_cache.folder_of(m, block_dim))]
    _say_damaged(found)
    for module in found:
        kernel_cache.remove(kernel_cache.folder_of(module, block_dim))


def _say_damaged(modules: list[Any]) -> None:
    if modules:
        names = ", ".join(m.name.removeprefix("ggwarp.kernels.") for m in modules)
        _log.warning("the kernel cache %s was damaged: %s compiled again", wp.config.kernel_cache_dir, names)


def _load_all(modules: list[Any], device: Any) -> None:
    waiting = deque(modules)
    ended, errors = threading.Event(), list[BaseException]()

    def work(take: Callable[[], Any]) -> None:
        with contextlib.suppress(IndexError):  # none is left
            while not ended.is_set():
                module = take()
                try:
                    _load_one(module, device)
                except BaseException as error:
                    errors.append(error)
                    ended.set()

    count = min(os.cpu_count() or 1, len(modules))
    left = threading.Semaphore(
        0
    )  # not join(): when it is interrupted, Python 3.11 takes the thread for ended

    def worker(take: Callable[[], Any]) -> None:
        try:
            work(take)
        finally:
            left.release()

    # Daemons, not a pool: the program would wait for a pool's whole queue before it ends.
    for i in range(count):
        take = waiting.popleft if i % 2 else waiting.pop  # from both ends: see load
        threading.Thread(target=worker, args=(take,), name="ggwarp-load", daemon=True).start()
    waited = 0
    try:
        while waited < count:
            left.acquire()
            waited += 1
    except BaseException:
        ended.set()
        deadline = time.monotonic() + _PATIENCE
        while waited < count and left.acquire(timeout=max(0.0, deadline - time.monotonic())):
            waited += 1
        raise
    if errors:
        raise errors[0]


def _load_one(module: Any, device: Any) -> None:
    failure: Exception | None = None
    for _ in range(_ATTEMPTS):
        cache = str(wp.config.kernel_cache_dir)
        try:
            wp.force_load(device=device, modules=[module], max_workers=0)
            folder = kernel_cache.folder_of(module, _block_dim(device))
            if not kernel_cache.is_sealed(folder):
                _look_up_kernels(module, device)
                kernel_cache.seal(folder)
            return
        except Exception as error:
            failure = error
            _mend(module, device, cache, error)
    assert failure is not None
    raise failure


def _look_up_kernels(module: Any, device: Any) -> None:
    """Check that the kernels of a loaded module are in it.

    Raises:
        RuntimeError: one is not.
    """
    device = wp.get_device(device)
    for (context, _), loaded in list(module.execs.items()):
        for kernel in module.kernels.values() if context == device.context else ():
            if not kernel.is_generic and loaded.get_kernel_hooks(kernel).forward is None:
                raise RuntimeError(f"{module.name}: {kernel.key} is missing in the compiled file")


def _mend(module: Any, device: Any, cache: str, error: Exception) -> None:
    """Do what may let a module load that did not; else raise ``error``."""
    kernel_cache.clear_builds()
    module.unload()  # Warp keeps what it has otherwise, and a failure to compile, too
    folder = kernel_cache.folder_of(module, _block_dim(device))
    changed = cache != str(wp.config.kernel_cache_dir)  # by another thread
    if changed or isinstance(error, FileNotFoundError):  # another program has removed it
        return
    reason = kernel_cache.why_not_writable()
    if reason is not None:
        kernel_cache.use_temporary(cache, reason)
    elif kernel_cache.binaries(folder):  # looks sound, and does not load
        _say_damaged([module])
        kernel_cache.remove(folder)
    else:
        raise error


@contextlib.contextmanager
def _compiler_s_words() -> Iterator[None]:
    """Pass on what the compiler says when it is done, but for what it could do without."""
    lines: list[str] = []
    try:
        with kernel_cache.held_stderr() as lines:
            yield
    finally:
        without = any("compiling without precompiled headers" in line for line in lines)
        for line in lines:
            if not _LOOK_UP.search(line) and not (without and _HEADERS.search(line)):
                print(line, file=sys.stderr)


def init_quietly() -> None:
    """Start Warp without its greeting, and without its warning where there is no NVIDIA driver.

    Warp shall compile for the very device: its own choice depends on the driver, and may miss what was
    compiled beforehand.
    """
    wp.config.log_level = wp.LOG_WARNING
    wp.config.cuda_output = wp.config.cuda_output or "cubin"
    try:
        tempfile.gettempdir()
    except OSError:
        wp.config.use_precompiled_headers = False  # they lie in the temporary folder
    sys.stderr.flush()
    # The warning comes from native code: only the file descriptor can hold it back.
    with kernel_cache.held_stderr() as lines:
        try:
            wp.init()
        except OSError as error:
            kernel_cache.use_temporary(str(wp.config.kernel_cache_dir or ""), error)
            wp.init()
    for device in wp.get_cuda_devices():
        if wp.is_mempool_enabled(device):
            # Else every wait gives unused memory back to the driver, and the next frame asks for it again.
            wp.set_mempool_release_threshold(device, 0.5)
    for line in lines:
        if "Could not find or load the NVIDIA CUDA driver" not in line:
            print(line, file=sys.stderr)
