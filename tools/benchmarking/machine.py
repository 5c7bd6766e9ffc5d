# SPDX-License-Identifier: Apache-2.0
"""What the figures were measured on: its description and, in the same run, its limits."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

_ROOT = Path(__file__).parents[2]
_PACKAGES = ("ggwarp", "warp-lang", "torch", "numpy", "small_gicp", "gsplat")
_COPY_BYTES = 1 << 27
_MATRIX_SIZES = (512, 1024, 2048)
_LEAST_S = 0.3  # how long the best of repeats is looked for: other processes pause a moment, sooner or later


@dataclass(frozen=True)
class Limits:
    """What the machine can do at most, as measured.

    Attributes:
        copy: GB/s of a large copy, bytes read plus bytes written.
        fma: GFLOP/s in float32: the best of matrix products (512 to 2048) by torch and by NumPy.
    """

    copy: float
    fma: float

    def seconds(self, gflop: float, gigabytes: float) -> float:
        """Return the least time for so much arithmetic and traffic (a roofline)."""
        return max(gflop / self.fma, gigabytes / self.copy)

    def best(self, other: Limits) -> Limits:
        return Limits(max(self.copy, other.copy), max(self.fma, other.fma))


def measure_limits(device: Any, threads: int) -> Limits:
    """Measure :class:`Limits` with as many CPU threads as the kernels are given (or on a GPU)."""
    device = wp.get_device(device)
    if device.is_cpu:
        return Limits(_cpu_copy(threads), _cpu_fma(threads))
    return Limits(*_cuda_limits(f"cuda:{device.ordinal}"))


def _cpu_copy(threads: int) -> float:
    source = np.ones(_COPY_BYTES // 4, np.float32)
    target = np.zeros_like(source)
    parts = list(zip(np.array_split(target, threads), np.array_split(source, threads), strict=True))
    with ThreadPoolExecutor(threads) as pool:
        seconds = _best(lambda: list(pool.map(lambda part: np.copyto(*part), parts)))
    return 2.0 * source.nbytes / seconds / 1e9


def _cpu_fma(threads: int) -> float:
    best = 0.0
    kept = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for size in _MATRIX_SIZES:
            a, b = torch.rand(size, size), torch.rand(size, size)
            out = torch.empty(size, size)
            best = max(best, _gflops(size, _best(lambda: torch.mm(a, b, out=out))))  # noqa: B023
            # NumPy's library decides on its threads itself: it takes every core the process may use.
            if threads == cores():
                x, y = a.numpy(), b.numpy()
                best = max(best, _gflops(size, _best(lambda: np.matmul(x, y))))  # noqa: B023
    finally:
        torch.set_num_threads(kept)
    return best


def _cuda_limits(device: str) -> tuple[float, float]:
    source = torch.ones(_COPY_BYTES, device=device)
    target = torch.empty_like(source)

    def timed(work: Callable[[], object]) -> float:
        def run() -> None:
            for _ in range(10):
                work()
            torch.cuda.synchronize(device)

        return _best(run) / 10.0

    copy = 2.0 * source.nbytes / timed(lambda: target.copy_(source)) / 1e9
    kept = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        a = torch.rand(8192, 8192, device=device)
        return copy, _gflops(8192, timed(lambda: a @ a))
    finally:
        torch.backends.cuda.matmul.allow_tf32 = kept


def _gflops(size: int, seconds: float) -> float:
    return 2.0 * size**3 / seconds / 1e9


def _best(work: Callable[[], object]) -> float:
    """Return the least seconds that ``work`` took, of at least three times and 0.3 s."""
    work()
    seconds: list[float] = []
    while len(seconds) < 3 or sum(seconds) < _LEAST_S:
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def cores() -> int:
    """Return how many CPU cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def describe(device: Any) -> dict[str, Any]:
    """Return device, CPU, cores, load (processes that want one), versions, commit and date."""
    device = wp.get_device(device)
    return {
        "device": "cpu" if device.is_cpu else device.name,
        "cpu": _cpu_name(),
        "cores": cores(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {"python": platform.python_version(), **_versions(), **_cuda_version(device)},
        "commit": _commit(),
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _cuda_version(device: Any) -> dict[str, str]:
    return {} if device.is_cpu else {"cuda": str(torch.version.cuda)}


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def _commit() -> str | None:
    """Return the commit of this copy of the repository, marked where files differ from it."""
    command = ["git", "-C", str(_ROOT), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() or None
