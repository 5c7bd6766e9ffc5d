# SPDX-License-Identifier: Apache-2.0
"""Work that is recorded once and replayed: one call for many launches.

A recording keeps the launches' arguments: numbers by value, arrays by address. What changes from one replay
to the next must therefore be in an array, at the same place.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import warp as wp


class GraphCache:
    """Recordings of one piece of work in its variants, as long as its arrays stay where they are.

    While something is recorded ``device.is_capturing`` holds: launches are then not split over threads,
    cover all rows that there is room for, and must not depend on what the host reads. On the CPU another
    thread must not record at the same time; on CUDA, launch nothing on the same stream.
    """

    def __init__(self, device: Any) -> None:
        self._device = wp.get_device(device)
        self._arrays: Hashable = None
        self._graphs: dict[Hashable, Any] = {}

    def run(self, variant: Hashable, work: Callable[[], None], *, arrays: Hashable) -> None:
        """Do ``work``: directly the first time, recorded the second, replayed from then on.

        The direct run loads kernels and allocates; neither may happen in a recording.

        Args:
            variant: what distinguishes this work from other work on the same arrays.
            work: launches kernels and copies between arrays; reads nothing.
            arrays: differs from the last call's when an array was allocated anew or a number passed by
                value changed since: everything recorded so far is then dropped.
        """
        if arrays != self._arrays:
            self._graphs.clear()
            self._arrays = arrays
        if variant not in self._graphs:
            self._graphs[variant] = None
            work()
            return
        if self._graphs[variant] is None:
            self._graphs[variant] = self._record(work)
        wp.capture_launch(self._graphs[variant])

    def _record(self, work: Callable[[], None]) -> Any:
        wp.capture_begin(self._device)
        try:
            work()
        finally:
            graph = wp.capture_end(self._device)
        return graph
