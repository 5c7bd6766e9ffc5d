# SPDX-License-Identifier: Apache-2.0
"""Pools: everything is done once, whatever fails, stops or is lost; and within what a machine has."""

import contextlib
import logging
import os
import signal
import socket
import threading
import time

import pytest

from ggwarp.console import Verbosity, open_display
from ggwarp.suite import pool as pools
from ggwarp.suite.attempts import known_record
from ggwarp.suite.definition import SuiteError
from ggwarp.suite.execution import execute, open_site
from ggwarp.suite.job import Resources
from ggwarp.suite.pool import LocalPool, LostError, Place, gpu_places
from ggwarp.suite.ray_pool import RayPool
from ggwarp.suite.results import Results

SMALL = Resources(cpus=1, gpus=0.0, memory_gb=0.01)


def double(task: int, place: Place) -> int:
    if task == 3:
        raise ValueError("no threes")
    return 2 * task


@pytest.fixture(scope="module")
def cluster():
    """A Ray cluster of this machine, of one core."""
    pytest.importorskip("ray", reason="the extra cluster is not installed")
    from ray.cluster_utils import Cluster

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    made = Cluster(
        initialize_head=True,
        head_node_args={
            "num_cpus": 1,
            "object_store_memory": 80 << 20,
            "include_dashboard": False,
            "_system_config": {"health_check_failure_threshold": 3, "health_check_period_ms": 1000},
        },
    )
    yield made
    import ray

    ray.shutdown()
    made.shutdown()


@pytest.fixture
def ray_pool(cluster) -> RayPool:
    return RayPool(SMALL, address=cluster.address)


@pytest.fixture(params=["local", "ray"])
def pool(request: pytest.FixtureRequest):
    return LocalPool(SMALL, most=3) if request.param == "local" else request.getfixturevalue("ray_pool")


def test_every_task_is_done_once_and_a_failing_one_ends_none(pool):
    found = dict(pool.run(double, list(range(20))))
    error = found.pop(3)
    assert isinstance(error, ValueError) and str(error) == "no threes"
    assert found == {task: 2 * task for task in range(20) if task != 3}


def test_leaving_early_ends_what_goes_on(pool, tmp_path):
    def wait(task: int, place: Place) -> int:
        (tmp_path / f"{task}.{os.getpid()}").touch()
        while task and not place.stopped():
            time.sleep(0.01)
        return task

    with contextlib.closing(pool.run(wait, list(range(5)))) as loop:
        assert next(loop) == (0, 0)
        while not (others := [path for path in tmp_path.iterdir() if not path.name.startswith("0.")]):
            time.sleep(0.01)
    pids = {int(path.suffix[1:]) for path in others} - {os.getpid()}
    deadline = time.monotonic() + 30.0
    while any(os.path.exists(f"/proc/{pid}") for pid in pids):
        assert time.monotonic() < deadline, "Ray has not ended its tasks"
        time.sleep(0.05)
    assert len(list(tmp_path.iterdir())) < 5, "the last ones have not begun"


def test_no_more_tasks_at_a_time_than_there_is_room_for():
    lock, going, most = threading.Lock(), 0, 0

    def work(task: int, place: Place) -> None:
        nonlocal going, most
        with lock:
            going += 1
            most = max(most, going)
        time.sleep(0.01)
        with lock:
            going -= 1

    list(LocalPool(SMALL, most=3).run(work, list(range(30))))
    assert most == min(3, pools.cores())


@pytest.mark.parametrize(
    ("resources", "count"),
    [
        (Resources(cpus=1, memory_gb=1.0), 8),
        (Resources(cpus=3, memory_gb=1.0), 2),
        (Resources(cpus=1, memory_gb=4.0), 5),
        (Resources(cpus=16, memory_gb=1.0), 1),
        (Resources(cpus=1, memory_gb=64.0), 1),
    ],
)
def test_a_machine_s_cores_and_memory_decide(monkeypatch, resources: Resources, count: int):
    monkeypatch.setattr(pools, "cores", lambda: 8)
    monkeypatch.setattr(pools, "free_memory_gb", lambda: 20.0)
    monkeypatch.setattr(pools, "visible_gpus", list)
    assert LocalPool(resources).count == count
    assert LocalPool(resources, most=1).count == 1


def test_gpus_are_handed_out(monkeypatch):
    monkeypatch.setattr(pools, "cores", lambda: 8)
    monkeypatch.setattr(pools, "free_memory_gb", lambda: 20.0)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,2,5")

    def where(resources: Resources) -> tuple[int, set[str]]:
        pool = LocalPool(resources)
        found = pool.run(lambda task, place: time.sleep(0.02) or place.environment.copy(), list(range(12)))
        return pool.count, {environment.get("CUDA_VISIBLE_DEVICES", "") for _, environment in found}

    assert where(Resources(memory_gb=1.0)) == (3, {"0", "2", "5"}), "one each, where nothing is said"
    assert where(Resources(gpus=2.0, memory_gb=1.0)) == (1, {"0,2"})
    assert where(Resources(gpus=0.5, memory_gb=1.0)) == (6, {"0", "2", "5"})
    assert where(Resources(gpus=0.0, memory_gb=1.0)) == (8, {""})
    assert gpu_places([], 1.0) == []


def test_a_head_that_does_not_answer_is_one_line():
    pytest.importorskip("ray", reason="the extra cluster is not installed")
    import ray

    ray.shutdown()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and nobody listens
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(SuiteError, match=rf"--ray {address}: no such cluster .*; ray start --head"):
            RayPool(SMALL, address=address)


def test_a_cluster_that_is_too_small_is_one_line(ray_pool, cluster):
    with pytest.raises(SuiteError, match=r"no machine there has 9 cores, 0 GPUs and 0.01 GB; ask for less"):
        RayPool(Resources(cpus=9, gpus=0.0, memory_gb=0.01), address=cluster.address)


def test_a_task_whose_machine_is_lost_each_time_is_named(ray_pool, monkeypatch):
    monkeypatch.setattr("ggwarp.suite.ray_pool._MOST_LOST", 0)

    def die(task: int, place: Place) -> int:
        if task == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return task

    found = dict(ray_pool.run(die, [0, 1, 2]))
    lost = found.pop(1)
    assert isinstance(lost, LostError) and "lost" in str(lost) and found == {0: 0, 2: 2}


def test_runs_of_a_lost_machine_are_done_elsewhere_with_the_same_figures(
    ray_pool, cluster, site, suite_of, tmp_path
):
    """Two machines, one of them killed while it does a run: nothing is lost, and nothing differs."""
    logging.getLogger("ggwarp").setLevel(logging.ERROR)
    suite = suite_of("waiting-a", "waiting-b", "room0", resources=SMALL)
    victim = cluster.add_node(num_cpus=1, object_store_memory=80 << 20)
    pool = RayPool(SMALL, address=cluster.address)
    begun = [site.folder / f"runs/{name}/slow/seed-0.json" for name in ("waiting-a", "waiting-b")]
    results: list[Results] = []
    display = open_display(Verbosity.QUIET)
    thread = threading.Thread(target=lambda: results.append(execute(suite, site, pool, display)))
    thread.start()
    while not all(path.is_file() for path in begun):
        time.sleep(0.05)
    cluster.remove_node(victim, allow_graceful=False)
    (site.folder / "go").touch()
    thread.join(60.0)
    assert results and results[0].count("done") == 6
    alone = open_site(tmp_path / "alone", data=site.data, command=site.command)
    (alone.folder / "go").touch()
    local = execute(suite, alone, LocalPool(SMALL), display)
    assert [run.metrics for run in results[0].runs] == [run.metrics for run in local.runs]
    assert known_record(site, suite.jobs()[0]).status == "done"
