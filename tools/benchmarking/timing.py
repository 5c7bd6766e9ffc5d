# SPDX-License-Identifier: Apache-2.0
"""Interleaved timing: all candidates once a round, so that a busy machine slows all alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

_MIN_CUDA_S = 5e-3  # launches are timed in batches of at least so long, or one would time the driver


@dataclass(frozen=True)
class Timing:
    """Repeated times of one piece of work.

    Attributes:
        samples: seconds, one a round.
    """

    samples: tuple[float, ...]

    @property
    def median(self) -> float:
        """Seconds."""
        return float(np.median(self.samples))

    @property
    def best(self) -> float:
        """Seconds."""
        return min(self.samples)

    @property
    def spread(self) -> float:
        """Interquartile range over the median."""
        low, high = np.quantile(self.samples, [0.25, 0.75])
        return float((high - low) / self.median) if self.median > 0.0 else 0.0

    def over(self, other: Timing) -> float:
        """Return the median of the rounds' ratios to ``other``, which was measured beside this."""
        return float(np.median(np.divide(self.samples, other.samples)))


@dataclass(frozen=True)
class Work:
    """Something to time.

    Attributes:
        run: the work.
        prepare: done before each batch, untimed; the batch is then as large as ``batch`` says.
        batch: runs a sample; the sample is their mean. On CUDA more, if they are short.
    """

    run: Callable[[], object]
    prepare: Callable[[], object] | None = None
    batch: int = 1


def measure(
    works: Mapping[str, Work | Callable[[], object]],
    *,
    device: Any,
    rounds: int,
    budget_s: float = float("inf"),
) -> dict[str, Timing]:
    """Time each of ``works`` once a round, in their order, after one round unmeasured.

    Args:
        works: name -> work.
        device: a Warp device; it is synchronised round every sample.
        rounds: samples each.
        budget_s: no further round starts after so many seconds; at least three are done (or ``rounds``).
    """
    device = wp.get_device(device)
    todo = {name: work if isinstance(work, Work) else Work(work) for name, work in works.items()}
    batches = {}
    for name, work in todo.items():
        _sample(work, work.batch, device)
        batches[name] = work.batch
        if not device.is_cpu and work.prepare is None:
            # What is recorded and replayed comes to its pace at the third run only.
            seconds = [_sample(work, work.batch, device) for _ in range(3)][-1]
            batches[name] *= max(1, round(_MIN_CUDA_S / max(seconds * work.batch, 1e-7)))
    samples: dict[str, list[float]] = {name: [] for name in todo}
    started = time.perf_counter()
    for done in range(rounds):
        if done >= 3 and time.perf_counter() - started > budget_s:
            break
        for name, work in todo.items():
            samples[name].append(_sample(work, batches[name], device))
    return {name: Timing(tuple(values)) for name, values in samples.items()}


def _sample(work: Work, batch: int, device: Any) -> float:
    """Return the mean seconds of ``batch`` runs."""
    if work.prepare is not None:
        work.prepare()
    _wait_for(device)
    started = time.perf_counter()
    for _ in range(batch):
        work.run()
    _wait_for(device)
    return (time.perf_counter() - started) / batch


def _wait_for(device: Any) -> None:
    """Wait for all streams of a CUDA device, torch's too; the CPU has done its work already."""
    if not device.is_cpu:
        wp.synchronize_device(device)
