# SPDX-License-Identifier: Apache-2.0
"""The built-in suite on this machine and on a Ray cluster, with a run killed, one refused, a machine lost.

Run whole with --reliability -s alone: it takes minutes, and prints what Ray costs.
"""

import dataclasses
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from ggwarp.console import Verbosity, open_display
from ggwarp.results.metrics import RESULTS
from ggwarp.suite.definition import Sequence, Suite
from ggwarp.suite.execution import execute, open_site
from ggwarp.suite.job import Resources
from ggwarp.suite.pool import LocalPool
from ggwarp.suite.results import Results
from ggwarp.suite.suite_file import load_suite

TIMES = {*RESULTS["pace"], *RESULTS["time and memory"]} - {"iterations_per_frame"}
SMALL = Resources(cpus=1, gpus=0.0, memory_gb=0.2)


@pytest.fixture(autouse=True)
def whole(campaign: bool) -> None:
    if not campaign:
        pytest.skip("a campaign of minutes: --reliability")


@pytest.fixture(scope="module")
def suite() -> Suite:
    """Built-in, with few frames, and a recording that is none."""
    found = load_suite("built-in")
    options = found.options | {"frames": "0:5", "checkpoint-every": "1"}
    sequences = (*found.sequences, Sequence("refused", "refused"))
    return dataclasses.replace(found, options=options, sequences=sequences)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("suites")


def run(suite: Suite, out: Path, pool) -> tuple[Results, float]:
    """Return what was measured, and the seconds it took."""
    (out.parent / "data/refused").mkdir(parents=True, exist_ok=True)
    site = open_site(out, data=out.parent / "data", device="cpu")
    started = time.perf_counter()
    results = execute(suite, site, pool, open_display(Verbosity.NORMAL))
    return results, time.perf_counter() - started


def figures(results: Results) -> dict[str, dict[str, float]]:
    return {r.label: {k: v for k, v in r.metrics.items() if k not in TIMES} for r in results.runs}


def kill_a_run(out: Path) -> None:
    """Kill the first run that has a checkpoint."""
    while not (found := list(out.glob("runs/*/*/.*partial-*/checkpoints/*.safetensors"))):
        time.sleep(0.01)
    os.kill(int(found[0].parents[1].name.rpartition("-")[2]), signal.SIGKILL)


@pytest.fixture(scope="module")
def local(suite: Suite, folder: Path) -> Results:
    """Results on this machine, with a run killed on its way."""
    out = folder / "local"
    threading.Thread(target=kill_a_run, args=(out,), daemon=True).start()
    pool = LocalPool(SMALL, most=2)
    results, seconds = run(suite, out, pool)
    waited = pool.count * seconds - sum(result.wall_s for result in results.runs)
    print(f"local: {seconds:.0f} s, beside the runs {100.0 * waited / (pool.count * seconds):.1f} %")
    return results


def test_the_table_is_whole_and_a_second_start_does_only_what_is_missing(local, suite, folder):
    states = {result.label: (result.status, result.attempts) for result in local.runs}
    good = {label: state for label, state in states.items() if not label.startswith("refused")}
    assert len(good) == 12 and {status for status, _ in good.values()} == {"done"}
    assert sorted(attempts for _, attempts in good.values()) == [1] * 11 + [2], "one was killed"
    assert local.count("failed") == 4 and all(
        "refused" in r.reason for r in local.runs if r.status == "failed"
    )
    again, _ = run(suite, folder / "local", LocalPool(SMALL, most=2))
    assert {r.label: r.attempts for r in again.runs if r.status == "done"} == {
        k: v[1] for k, v in good.items()
    }


def test_on_a_cluster_that_loses_a_machine_figures_are_the_same_to_the_bit(local, suite, folder):
    pytest.importorskip("ray", reason="the extra cluster is not installed")
    from ray.cluster_utils import Cluster

    from ggwarp.suite.ray_pool import RayPool

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    head = {"num_cpus": 1, "object_store_memory": 80 << 20, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    victim = cluster.add_node(num_cpus=1, object_store_memory=80 << 20)
    out = folder / "ray"

    def lose_a_machine() -> None:
        while len(list(out.glob("runs/*/*/seed-*/metrics.json"))) < 3:
            time.sleep(0.05)
        cluster.remove_node(victim, allow_graceful=False)

    threading.Thread(target=lose_a_machine, daemon=True).start()
    results, seconds = run(suite, out, RayPool(SMALL, address=cluster.address))
    import ray

    ray.shutdown()
    cluster.shutdown()
    print(f"Ray, a machine lost: {seconds:.0f} s")
    assert results.count("done") == 12 and figures(results) == figures(local)


def test_a_thousand_tasks_cost_little_more_than_themselves():
    ray = pytest.importorskip("ray", reason="the extra cluster is not installed")
    from ggwarp.suite.ray_pool import RayPool

    ray.init(num_cpus=8, include_dashboard=False, log_to_driver=False, object_store_memory=80 << 20)
    pool = RayPool(SMALL)

    def nap(task: int, place) -> int:
        time.sleep(0.2)
        return task

    list(pool.run(nap, range(16)))  # Ray's workers begin
    started = time.perf_counter()
    done = dict(pool.run(nap, range(1000)))
    seconds = time.perf_counter() - started
    ray.shutdown()
    print(f"1,000 tasks of 0.2 s, 8 at a time: {seconds:.1f} s, {100.0 * (seconds / 25.0 - 1.0):.1f} % more")
    assert done == {task: task for task in range(1000)}
