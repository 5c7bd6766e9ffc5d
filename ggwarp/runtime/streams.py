# SPDX-License-Identifier: Apache-2.0
"""Meeting the device: reading results, bounding the work that waits for it, and sharing it by two threads.

On CUDA everything is queued on the device's current stream and the host runs ahead. Warp knows one current
stream a device, not one a thread. Where two threads share a device each has a stream of its own and queues
its work inside a :class:`StreamScope`, while the other does not; it lets the other in whenever it waits for
the device. What both have queued runs at the same time. On a CPU launches need no such care.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from types import TracebackType
from typing import Any

import numpy as np
import warp as wp

Scope = contextlib.AbstractContextManager[Any]
"""A thread enters its scope to work on the device, for milliseconds at a time."""

NO_LOCK: Scope = contextlib.nullcontext()
"""The scope of a thread that has the device to itself."""


def to_host(array: Any) -> np.ndarray:
    """Return ``array`` as NumPy; waits for its device's current stream, and for no other.

    ``array.numpy()`` makes CUDA's default stream the current one for a while instead, which waits for every
    stream and would catch what other threads launch. On a CPU the array's own memory is returned.
    """
    if array.device.is_cpu:
        return array.numpy()
    _wait_for(array.device.stream.record_event())
    host = wp.empty(array.shape, dtype=array.dtype, device="cpu")
    wp.copy(host, array)
    wp.synchronize_stream(array.device.stream)
    return host.numpy()


def _wait_for(event: Any) -> None:
    """Let the other thread in until ``event`` has happened.

    It may record a graph meanwhile, and ``wp.synchronize_event`` refuses to wait while any thread records.
    """
    runtime = event.device.runtime
    with outside_scope():
        # Outside its scope a thread of ours has no CUDA context, which the driver's call asks for.
        event.device.make_current()
        done = runtime.core.wp_cuda_event_synchronize(event.cuda_event)
    if not done:
        raise RuntimeError(f"{event.device}: {runtime.get_error_string()}")


class Backlog:
    """Keeps the host at most ``limit`` pieces of work ahead of the device.

    Without it a loop that reads nothing back would queue work for seconds, and its clock would tell
    nothing. On the CPU work is done when its launch returns: nothing to bound.
    """

    def __init__(self, device: Any, *, limit: int = 2) -> None:
        self._device = wp.get_device(device)
        self._events = [] if self._device.is_cpu else [wp.Event(self._device) for _ in range(limit)]
        self._count = 0

    def added(self) -> None:
        """Note a piece queued on the current stream; wait for the one ``limit`` before it."""
        if not self._events:
            return
        event = self._events[self._count % len(self._events)]
        if self._count >= len(self._events):
            _wait_for(event)
        self._device.stream.record_event(event)
        self._count += 1


class FairLock:
    """A lock for two threads: whoever waits is next.

    A plain lock goes back to a thread that releases and takes it in a loop, however long another waits.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._next = threading.Lock()

    def __enter__(self) -> None:
        with self._next:
            self._lock.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()

    @property
    def awaited(self) -> bool:
        """Whether a thread waits to be the next."""
        return self._next.locked()


class StreamScope(contextlib.AbstractContextManager[None]):
    """Work queued inside goes to ``stream``, and no other thread that shares ``lock`` queues any."""

    def __init__(self, stream: Any, lock: FairLock) -> None:
        self._stream = stream
        self._lock = lock

    def __enter__(self) -> None:
        self._lock.__enter__()
        # What passes between the threads passes over the host: the streams need not wait for each other.
        self._stream_scope = wp.ScopedStream(self._stream, sync_enter=False)
        self._stream_scope.__enter__()
        _thread.scope = self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _thread.scope = None
        try:
            self._stream_scope.__exit__(kind, error, trace)
        finally:
            self._lock.__exit__(kind, error, trace)


_thread = threading.local()


@contextlib.contextmanager
def outside_scope() -> Iterator[None]:
    """Leave the stream scope that the calling thread is in, if any, for as long as it only waits."""
    scope: StreamScope | None = getattr(_thread, "scope", None)
    if scope is None:
        yield
        return
    scope.__exit__(None, None, None)
    try:
        yield
    finally:
        scope.__enter__()


@contextlib.contextmanager
def stream_scopes(device: Any) -> Iterator[tuple[Scope, Scope]]:
    """Open a stream scope on ``device`` for either of two threads; the first one's work has priority.

    They begin where the device's own stream is, and that goes on when both are done.
    """
    device = wp.get_device(device)
    if device.is_cpu:
        yield NO_LOCK, NO_LOCK
        return
    own = device.stream
    streams = [wp.Stream(device, priority=priority) for priority in (-1, 0)]
    lock = FairLock()
    for stream in streams:
        stream.wait_stream(own)
    try:
        yield StreamScope(streams[0], lock), StreamScope(streams[1], lock)
    finally:
        for stream in streams:
            own.wait_stream(stream)
