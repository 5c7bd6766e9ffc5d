# SPDX-License-Identifier: Apache-2.0
"""A suite of the command's own runs: killed on the way, it has the figures of a run by hand."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time

from ggwarp.console import Verbosity, open_display
from ggwarp.results.metrics import RESULTS
from ggwarp.suite.attempts import known_record
from ggwarp.suite.definition import Sequence, Setting, Suite
from ggwarp.suite.execution import execute, open_site
from ggwarp.suite.job import Resources
from ggwarp.suite.pool import LocalPool

TIMES = {*RESULTS["pace"], *RESULTS["time and memory"]} - {"iterations_per_frame"}
OPTIONS = {"frames": "0:4", "scale": 0.05, "save-renders": 0, "checkpoint-every": "1"}


def test_a_killed_run_has_the_figures_of_one_by_hand(tmp_path):
    logging.getLogger("ggwarp").setLevel(logging.ERROR)
    suite = Suite(
        "real", (Sequence("office", "office"),), (Setting("fast", {"preset": "fast"}),), options=OPTIONS
    )
    site = open_site(tmp_path / "suite", data=tmp_path / "data", device="cpu")
    [job] = suite.jobs()
    record, folder = site.record(job), site.run_folder(job)

    def kill_once_it_has_a_checkpoint() -> None:
        while not (found := list(folder.parent.glob(".*partial-*/checkpoints/*.safetensors"))):
            time.sleep(0.005)
        pid = int(found[0].parents[1].name.rpartition("-")[2])
        os.kill(pid, signal.SIGKILL)

    killer = threading.Thread(target=kill_once_it_has_a_checkpoint, daemon=True)
    killer.start()
    words = ["--seq", "office", "--device", "cpu", *job.arguments, "--out", str(tmp_path / "by-hand")]
    by_hand = subprocess.Popen(
        [sys.executable, "-m", "ggwarp", "run", "-q", *words], stdout=subprocess.DEVNULL
    )
    pool = LocalPool(Resources(gpus=0.0, memory_gb=0.1), most=1)
    results = execute(suite, site, pool, open_display(Verbosity.QUIET))
    assert by_hand.wait() == 0 and results.count("done") == 1 and record.is_file()
    first, second = known_record(site, job).attempts
    assert (first.exit_code, first.reason, second.exit_code) == (-9, "killed by SIGKILL", 0)
    assert second.resumed and second.cpu_s is not None and second.cpu_s > 0.1
    alone = json.loads((tmp_path / "by-hand/metrics.json").read_text())
    figures = results.runs[0].metrics
    assert figures["psnr"] > 15.0 and figures["frames"] == 4
    assert {k: v for k, v in figures.items() if k not in TIMES} == {
        k: v for k, v in alone.items() if k in figures and k not in TIMES
    }


def test_a_run_ends_with_the_worker_that_began_it(tmp_path):
    """A worker that is killed cannot end its run; the system does."""
    words = ["--seq", "office", "--device", "cpu", "--scale", "0.05", "--out", str(tmp_path / "run")]
    worker = (
        "import os, subprocess, sys, time; "
        "child = subprocess.Popen([sys.executable, '-m', 'ggwarp.suite.child', str(os.getpid()), '1', "
        f"*{words!r}]); print(child.pid, flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", worker], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    pid = int(process.stdout.readline())
    process.stdout.close()
    while not list(tmp_path.glob(".run.partial-*")):
        time.sleep(0.02)
    process.kill()
    process.wait()
    deadline = time.monotonic() + 60.0
    while os.path.exists(f"/proc/{pid}") and "Z" not in open(f"/proc/{pid}/stat").read().split()[2]:
        assert time.monotonic() < deadline, "it goes on"
        time.sleep(0.05)
