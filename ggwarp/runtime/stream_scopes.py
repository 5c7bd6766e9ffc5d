# SPDX-License-Identifier: Apache-2.0
"""Two threads on one device: a CUDA stream for either, and turns to queue work on it.

Warp knows one current stream a device, not one a thread. A thread therefore sets its stream and queues its
work while the other does not, and lets the other in whenever it waits for the device; what both have queued
runs at the same time. On a CPU launches need no such care, and a lane is nothing.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from types import TracebackType
from typing import Any

import warp as wp

Lane = contextlib.AbstractContextManager[Any]
"""A thread enters its lane to work on the device, for milliseconds at a time."""

OPEN_ROAD: Lane = contextlib.nullcontext()
"""The lane of a thread that has the device to itself."""


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


class StreamLane(contextlib.AbstractContextManager[None]):
    """Work queued inside goes to ``stream``, and no other thread that shares ``lock`` queues any."""

    def __init__(self, stream: Any, lock: FairLock) -> None:
        self._stream = stream
        self._lock = lock

    def __enter__(self) -> None:
        self._lock.__enter__()
        # What passes between the threads passes over the host: the streams need not wait for each other.
        self._scope = wp.ScopedStream(self._stream, sync_enter=False)
        self._scope.__enter__()
        _here.lane = self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _here.lane = None
        try:
            self._scope.__exit__(kind, error, trace)
        finally:
            self._lock.__exit__(kind, error, trace)


_here = threading.local()


@contextlib.contextmanager
def stepped_out() -> Iterator[None]:
    """Leave the lane that the calling thread is in, if any, for as long as it only waits."""
    lane: StreamLane | None = getattr(_here, "lane", None)
    if lane is None:
        yield
        return
    lane.__exit__(None, None, None)
    try:
        yield
    finally:
        lane.__enter__()


@contextlib.contextmanager
def two_lanes(device: Any) -> Iterator[tuple[Lane, Lane]]:
    """Open two lanes on ``device``; the first one's work goes before the second's.

    They begin where the device's own stream is, and that goes on when both are done.
    """
    device = wp.get_device(device)
    if device.is_cpu:
        yield OPEN_ROAD, OPEN_ROAD
        return
    own = device.stream
    streams = [wp.Stream(device, priority=priority) for priority in (-1, 0)]
    lock = FairLock()
    for stream in streams:
        stream.wait_stream(own)
    try:
        yield StreamLane(streams[0], lock), StreamLane(streams[1], lock)
    finally:
        for stream in streams:
            own.wait_stream(stream)
