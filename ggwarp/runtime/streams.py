# SPDX-License-Identifier: Apache-2.0
"""Meeting the device: reading results, and bounding the work that waits for it.

On CUDA everything is queued on the device's current stream and the host runs ahead.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ggwarp.runtime.stream_scopes import stepped_out


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
    """Let the other side in until ``event`` has happened.

    It may record a graph meanwhile, and ``wp.synchronize_event`` refuses to wait while any thread records.
    """
    runtime = event.device.runtime
    with stepped_out():
        # Outside its lane a thread of ours has no CUDA context, which the driver's call asks for.
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
