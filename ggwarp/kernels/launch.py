# SPDX-License-Identifier: Apache-2.0
"""Where a kernel runs: device choice, and the split of CPU launches over threads.

A Warp CPU launch runs on one core and releases the interpreter lock. Kernels that are worth
splitting take ``offset: int`` as their first parameter and work on ``offset + wp.tid()``;
:func:`launch_split` then runs pieces of the range on a small thread pool. Pieces must not
share outputs.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

_MIN_PIECE = 64
_pool: ThreadPoolExecutor | None = None
_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def cpu_threads() -> int:
    """Return how many threads a split CPU launch uses (default: the cores this process may use)."""
    return _threads


def set_cpu_threads(count: int) -> None:
    """Set how many threads a split CPU launch uses; results do not depend on it."""
    global _pool, _threads
    if count < 1:
        raise ValueError(f"cpu threads: {count}, but at least 1 is needed")
    if _pool is not None:
        _pool.shutdown()
        _pool = None
    _threads = count


def launch_split(
    kernel: Any,
    count: int,
    *,
    inputs: list[Any],
    outputs: list[Any] = [],  # noqa: B006 - never mutated
    device: Any,
    min_piece: int = _MIN_PIECE,
) -> None:
    """Launch ``kernel`` over ``range(count)``, split over threads on the CPU.

    Args:
        kernel: its first parameter is ``offset: int``, added to ``wp.tid()``.
        count: items in all.
        inputs: arguments after ``offset``.
        outputs: arguments after those; each item writes its own part of them.
        device: a Warp device.
        min_piece: do not split below this many items a thread.
    """
    global _pool
    if count <= 0:
        return
    device = wp.get_device(device)
    pieces = min(_threads, count // max(min_piece, 1)) if device.is_cpu else 1
    if pieces <= 1:
        wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=outputs, device=device)
        return
    if _pool is None:
        _pool = ThreadPoolExecutor(_threads, thread_name_prefix="ggwarp-launch")
    # Load the module here: two threads must not compile it at once. CPU launches run with blocks of one;
    # loading for another block size would compile the module a second time.
    kernel.module.load(device, block_dim=1)
    bounds = [count * i // pieces for i in range(pieces + 1)]

    def run(piece: int) -> None:
        begin, end = bounds[piece], bounds[piece + 1]
        wp.launch(kernel, dim=end - begin, inputs=[begin, *inputs], outputs=outputs, device=device)

    futures = [_pool.submit(run, piece) for piece in range(1, pieces)]
    run(0)
    for future in futures:
        future.result()
