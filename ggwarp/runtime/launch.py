# SPDX-License-Identifier: Apache-2.0
"""Where a kernel runs: device choice, and the split of CPU launches over threads.

A Warp CPU launch runs on one core and releases the interpreter lock. Kernels that are worth
splitting take ``offset: int`` as their first parameter and work on ``offset + wp.tid()``;
:func:`launch_split` then cuts the range into pieces that threads take from one queue: a thread on a
busy core takes fewer, and none is waited for before it has begun. Pieces must not share outputs.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from copy import copy
from functools import lru_cache
from typing import Any

import warp as wp

_MIN_PIECE = 64
_SMALLEST_SHARE = 16
"""The smallest pieces are this fraction of a thread's fair share."""

_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
_caller = threading.local()
_pool: tuple[int, ThreadPoolExecutor] | None = None
_pool_lock = threading.Lock()


def cpu_threads() -> int:
    """Return how many threads a split CPU launch of the calling thread uses.

    The default is the number of cores this process may use; :func:`cpu_thread_limit` lowers it.
    """
    return min(_threads, getattr(_caller, "limit", _threads))


def set_cpu_threads(count: int) -> None:
    """Set how many threads a split CPU launch uses; results do not depend on it."""
    global _threads
    _check(count)
    _threads = count


@contextmanager
def cpu_thread_limit(count: int) -> Iterator[None]:
    """Let the calling thread's split launches use at most ``count`` threads, itself included."""
    _check(count)
    before = getattr(_caller, "limit", None)
    _caller.limit = count
    try:
        yield
    finally:
        if before is None:
            del _caller.limit
        else:
            _caller.limit = before


def block_size(kernel: Any) -> int:
    """Return the threads of a block that a kernel's module is compiled for (its option ``block_dim``).

    A launch with blocks of another size would compile the module a second time.
    """
    return kernel.module.options["block_dim"]


Work = Callable[[], None]
"""A launch, or several, to be done as often as it is called."""


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

    Several threads may do so at once. While a graph is being recorded the launch is not split.

    Args:
        kernel: its first parameter is ``offset: int``, added to ``wp.tid()``.
        count: items in all.
        inputs: arguments after ``offset``.
        outputs: arguments after those; each item writes its own part of them.
        device: a Warp device.
        min_piece: do not make pieces of fewer items than this.
    """
    prepared_split(kernel, count, inputs=inputs, outputs=outputs, device=device, min_piece=min_piece)()


def prepared(kernel: Any, dim: Any, *, inputs: list[Any], outputs: list[Any], device: Any) -> Work:
    """Return a launch of ``kernel``, for loops: on a CPU its arguments are packed once, which takes longest.

    Numbers are kept by value, arrays by address. On CUDA, and in a recording, it is a launch like any other.
    """
    device = wp.get_device(device)

    def launch(**more: Any) -> Any:
        options = {"inputs": inputs, "outputs": outputs, "device": device, "block_dim": block_size(kernel)}
        return wp.launch(kernel, dim=dim, **options, **more)

    return launch(record_cmd=True).launch if device.is_cpu and not device.is_capturing else launch


def prepared_split(
    kernel: Any,
    count: int,
    *,
    inputs: list[Any],
    outputs: list[Any] = [],  # noqa: B006 - never mutated
    device: Any,
    min_piece: int = _MIN_PIECE,
) -> Work:
    """Return what :func:`launch_split` does, with as many threads as there are now; see :func:`prepared`."""
    if count <= 0:
        return lambda: None
    device = wp.get_device(device)
    threads = min(cpu_threads(), count // max(min_piece, 1)) if device.is_cpu else 1
    if threads <= 1 or device.is_capturing:
        return prepared(kernel, count, inputs=[0, *inputs], outputs=outputs, device=device)
    # Load the module here: two threads must not compile it at once. CPU launches run with blocks of one;
    # loading for another block size would compile the module a second time.
    kernel.module.load(device, block_dim=1)
    # Arguments are packed once: that holds the interpreter's lock for longer than all else here.
    packed: Any = wp.launch(
        kernel, dim=count, inputs=[0, *inputs], outputs=outputs, device=device, record_cmd=True
    )
    cut = _cut(count, threads, min_piece)

    def split() -> None:
        pieces = deque(cut)

        def work() -> None:
            command = copy(packed)
            command.params, command.fwd_args = list(packed.params), list(packed.fwd_args)
            while pieces:
                try:
                    begin, size = pieces.popleft()
                except IndexError:  # another thread was faster
                    return
                command.set_param_at_index(0, begin)
                command.set_dim(size)
                command.launch()

        _run_on_threads(work, threads)

    return split


def in_turn(*work: Work) -> Work:
    """Return work that does some one after another."""

    def all_of_it() -> None:
        for one in work:
            one()

    return all_of_it


def _run_on_threads(work: Callable[[], None], threads: int) -> None:
    """Run ``work`` here and on helpers that have time, until all that began have returned."""
    pool = _helpers(threads - 1)
    futures = [pool.submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        # A helper that has not begun would find nothing left to do.
        begun = [future for future in futures if not future.cancel()]
        for future in begun:
            future.result()


def _helpers(count: int) -> ThreadPoolExecutor:
    """Return a pool of at least ``count`` threads, shared by all callers; it never shrinks."""
    global _pool
    with _pool_lock:
        if _pool is None or _pool[0] < count:
            _pool = count, ThreadPoolExecutor(count, thread_name_prefix="ggwarp-launch")
        return _pool[1]


@lru_cache(maxsize=256)
def _cut(count: int, threads: int, min_piece: int) -> tuple[tuple[int, int], ...]:
    """Return (begin, size) of the pieces of ``range(count)``: large ones first, so that few are enough."""
    smallest = max(min_piece, count // (_SMALLEST_SHARE * threads))
    pieces, begin = [], 0
    while begin < count:
        left = count - begin
        size = max(smallest, left // (2 * threads))
        if left - size < smallest:
            size = left
        pieces.append((begin, size))
        begin += size
    return tuple(pieces)


def _check(count: int) -> None:
    if count < 1:
        raise ValueError(f"cpu threads: {count}, but at least 1 is needed")
