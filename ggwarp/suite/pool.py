# SPDX-License-Identifier: Apache-2.0
"""Where runs are done: an interface, and this machine, within its cores, memory and GPUs."""

from __future__ import annotations

import contextlib
import os
import queue
import subprocess
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeAlias, TypeVar

from ggwarp.suite.job import Resources

T = TypeVar("T")
R = TypeVar("R")

Finished: TypeAlias = Generator[tuple[T, R | Exception], None, None]
"""Tasks with their results, as they come; closing it ends what goes on."""


@dataclass(frozen=True)
class Place:
    """Where one task is done.

    Attributes:
        environment: variables that its processes need, such as which GPU is theirs.
        stopped: tells whether the task shall end early.
    """

    environment: Mapping[str, str] = field(default_factory=dict)
    stopped: Callable[[], bool] = lambda: False


class LostError(RuntimeError):
    """A task's worker was lost, as often as it was tried: one line."""


class Pool(Protocol):
    """Does tasks, some at a time."""

    @property
    def about(self) -> str:
        """What it is, in a few words."""
        ...

    def run(self, work: Callable[[T, Place], R], tasks: Sequence[T]) -> Finished[T, R]:
        """Do ``work`` on every task, and yield each with its result as soon as it is there.

        An exception of the work is a result, too: one task never ends the others. Where the caller leaves
        the loop, tasks that have begun are told to stop.
        """
        ...


class LocalPool:
    """This machine: as many tasks at a time as it has cores, memory and GPUs for."""

    def __init__(self, resources: Resources, *, most: int | None = None) -> None:
        """Look at the machine.

        Args:
            resources: what one task is given.
            most: tasks at a time at most; None: what the machine holds.
        """
        share = 1.0 if resources.gpus is None else resources.gpus
        places = gpu_places(visible_gpus(), share) if share else []
        fitting = [cores() // resources.cpus, int(free_memory_gb() / resources.memory_gb)]
        fitting += [len(places)] if places else []
        fitting += [] if most is None else [most]
        self.count = max(1, min(fitting))
        self._free: queue.SimpleQueue[dict[str, str]] = queue.SimpleQueue()
        for k in range(self.count):
            self._free.put({"CUDA_VISIBLE_DEVICES": places[k]} if places else {})

    @property
    def about(self) -> str:
        return f"{self.count} at a time on this machine"

    def run(self, work: Callable[[T, Place], R], tasks: Sequence[T]) -> Finished[T, R]:
        stop = threading.Event()

        def do(task: T) -> R:
            environment = self._free.get()
            try:
                return work(task, Place(environment, stop.is_set))
            finally:
                self._free.put(environment)

        with ThreadPoolExecutor(self.count, "ggwarp-suite") as threads:
            try:
                futures = {threads.submit(do, task): task for task in tasks}
                for future in as_completed(futures):
                    error = future.exception()
                    if error is not None and not isinstance(error, Exception):
                        raise error
                    yield futures[future], future.result() if error is None else error
            finally:
                stop.set()
                threads.shutdown(cancel_futures=True)


def gpu_places(gpus: Sequence[str], share: float) -> list[str]:
    """Return ``CUDA_VISIBLE_DEVICES`` of each task that finds room, at ``share`` GPUs a task."""
    if share < 1.0:
        return [gpu for gpu in gpus for _ in range(int(1.0 / share))]
    each = round(share)
    return [",".join(gpus[k : k + each]) for k in range(0, len(gpus) - each + 1, each)]


def cores() -> int:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def free_memory_gb() -> float:
    """Return the gigabytes of memory that are free by now, of the machine and of a container on it."""
    free = [64.0]  # where nobody says, cores decide
    with contextlib.suppress(OSError, ValueError, StopIteration, IndexError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = [int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1]) / 1e6]
    with contextlib.suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")
        limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
        free.append((limit - used) / 1e9)
    return max(0.0, min(free))


def visible_gpus() -> list[str]:
    """Return how CUDA names the GPUs that this process may use; empty: there are none."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [name for name in given.split(",") if name and name != "-1"]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(
            ["nvidia-smi", "--query-gpu=index", "--format=csv,noheader"],
            capture_output=True,
            text=True,
            timeout=30,
            check=True,
        )
        return done.stdout.split()
    return []
