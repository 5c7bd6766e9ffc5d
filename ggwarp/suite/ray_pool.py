# SPDX-License-Identifier: Apache-2.0
"""Many machines: a Ray cluster, which schedules the runs, and does those of a lost machine elsewhere."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from ggwarp.suite.definition import SuiteError
from ggwarp.suite.job import Resources
from ggwarp.suite.pool import Finished, LostError, Place

T = TypeVar("T")
R = TypeVar("R")

_WINDOW = 2000  # tasks that Ray holds at a time
_MOST_LOST = 5  # times that a task's machine may be lost
_ANSWER = 10.0  # seconds in which a head answers


class RayPool:
    """A Ray cluster whose machines have this version of ggwarp, and see the suite's folder.

    Where the caller of :meth:`run` leaves the loop early, this process leaves the cluster: Ray ends its
    tasks, and the runs that they have begun end with them, having saved what they have.
    """

    def __init__(self, resources: Resources, *, address: str = "auto", most: int | None = None) -> None:
        """Join the cluster.

        Args:
            resources: what Ray is asked for, for one task; without a number of GPUs one, where there is any.
            address: ``auto``: the cluster that this machine belongs to; ``local``: one of this machine alone,
                started now; else that of its head, or ``ray://HOST:PORT``.
            most: tasks at a time at most; None: what the cluster holds.

        Raises:
            SuiteError: Ray is not installed, there is no such cluster, or no machine of it is large enough.
        """
        self._ray = ray = _imported()
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        if not ray.is_initialized():
            try:
                _check_answers(address)
                ray.init(address=address, log_to_driver=False, logging_level="error")
            except (OSError, RuntimeError, ValueError) as error:
                reason = str(error).splitlines()[0]
                raise SuiteError(
                    f"--ray {address}: no such cluster ({reason}); ray start --head begins one here"
                ) from None
        self._most = most
        self._machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        gpus = resources.gpus
        if gpus is None:
            gpus = 1.0 if any(machine.get("GPU") for machine in self._machines) else 0.0
        self._asked = {"CPU": resources.cpus, "GPU": gpus, "memory": resources.memory_gb * 1e9}
        if not any(_holds(machine, self._asked) for machine in self._machines):
            raise SuiteError(
                f"--ray {address}: no machine there has {resources.cpus} cores, {gpus:g} GPUs and "
                f"{resources.memory_gb:g} GB; ask for less under [resources]"
            )

    @property
    def about(self) -> str:
        cores = sum(machine.get("CPU", 0.0) for machine in self._machines)
        return f"on a Ray cluster of {cores:g} cores in {len(self._machines)} machines"

    def run(self, work: Callable[[T, Place], R], tasks: Sequence[T]) -> Finished[T, R]:
        ray, waiting = self._ray, list(reversed(tasks))
        remote = ray.remote(
            num_cpus=self._asked["CPU"],
            num_gpus=self._asked["GPU"],
            memory=self._asked["memory"],
            max_retries=_MOST_LOST,
            scheduling_strategy="SPREAD",
        )(_task)
        shared = ray.put(work)
        window = min(_WINDOW, self._most or _WINDOW)
        going: dict[Any, T] = {}
        try:
            while waiting or going:
                while waiting and len(going) < window:
                    task = waiting.pop()
                    going[remote.remote(shared, task)] = task
                ray.wait(list(going))
                # All that are ready: one look at thousands of tasks costs as much as at one.
                ready, _ = ray.wait(list(going), num_returns=len(going), timeout=0.0)
                for reference in ready:
                    yield going.pop(reference), self._result(reference)
        finally:
            if going:
                # Not ray.cancel: of a task that ends at that moment, it takes this process along (Ray 2.60).
                ray.shutdown()

    def _result(self, reference: Any) -> Any:
        errors = self._ray.exceptions
        try:
            return self._ray.get(reference)
        except errors.RayTaskError as error:
            cause = error.cause
            return cause if isinstance(cause, Exception) else RuntimeError(str(error).splitlines()[-1])
        except errors.RayError as error:
            lines = str(error).splitlines() or [type(error).__name__]
            return LostError(f"its machine was lost: {lines[0]}")


def _task(work: Callable[[T, Place], R], task: T) -> R:
    """Do one task, in a process of Ray's."""
    return work(task, Place())


def _holds(machine: dict[str, float], asked: dict[str, float]) -> bool:
    return all(machine.get(name, 0.0) >= amount for name, amount in asked.items())


def _check_answers(address: str) -> None:
    """Refuse a head that does not answer; Ray would wait for it for minutes.

    Raises:
        OSError: it does not.
        ValueError: HOST:PORT has no such port.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon:
        socket.create_connection((host, int(port)), timeout=_ANSWER).close()


def _imported() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError:
        raise SuiteError("--ray: Ray is not installed; pip install 'ggwarp[cluster]'") from None
    return ray
