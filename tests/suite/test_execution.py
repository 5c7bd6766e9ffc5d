# SPDX-License-Identifier: Apache-2.0
"""A suite is whole whatever its runs do: killed, refused, broken, stopped, changed, without data."""

import contextlib
import dataclasses
import json
import logging
import os
import shutil
import threading
import time

import pytest

from ggwarp.console import Verbosity, open_display
from ggwarp.io.lock import lock_folder
from ggwarp.suite.attempts import known_record
from ggwarp.suite.definition import SuiteError
from ggwarp.suite.execution import execute, open_site
from ggwarp.suite.job import Resources
from ggwarp.suite.pool import LocalPool
from ggwarp.suite.results import Results

TWO = Resources(memory_gb=0.01)


@pytest.fixture
def run(site):
    """Executes a suite on two processes at a time, quietly."""

    def start(suite) -> Results:
        logging.getLogger("ggwarp").setLevel(logging.ERROR)
        return execute(suite, site, LocalPool(TWO, most=2), open_display(Verbosity.QUIET))

    return start


def tries(site, suite) -> dict[str, int]:
    return {job.name: len(known_record(site, job).attempts) for job in suite.jobs()}


def test_every_run_has_its_folder_and_its_figures(site, suite_of, run):
    suite = suite_of("room0", "room1", seeds=(0, 1))
    results = run(suite)
    assert [run.status for run in results.runs] == ["done"] * 8
    assert {run.folder for run in results.runs} == {
        f"runs/{seq}/{name}/seed-{n}"
        for seq in ("room0", "room1")
        for name in ("slow", "quick")
        for n in (0, 1)
    }
    for result in results.runs:
        assert json.loads((site.folder / result.folder / "metrics.json").read_text())["frames"] == 6
        assert "frames 0 to 6" in (site.folder / f"{result.folder}.log").read_text()
    mean = results.mean("room0", "slow", "psnr")
    assert mean is not None and mean.count == 2
    assert mean.value == 33.0 and mean.spread == pytest.approx(0.5**0.5), "30 + 5/2 and one more"
    assert results.average("quick", "psnr") == 31.125
    assert results.mean("room0", "slow", "lpips") is None, "null is no figure"


def test_one_killed_and_one_that_fails_leave_the_table_whole(site, suite_of, run, capsys):
    suite = suite_of("room0", "killed", "refused", "broken", settings=suite_of().settings[:1])
    results = run(suite)
    by_name = {result.sequence: result for result in results.runs}
    assert {name: result.status for name, result in by_name.items()} == {
        "room0": "done", "killed": "done", "refused": "failed", "broken": "failed"
    }  # fmt: skip
    assert by_name["refused"].reason == "exit code 2: refused/: is no recording"
    assert by_name["broken"].reason == "exit code 1: evaluation failed: out of luck"
    assert {name: result.attempts for name, result in by_name.items()} == {
        "room0": 1, "killed": 2, "refused": 2, "broken": 2
    }  # fmt: skip
    assert "refused, slow, seed 0: failed" in capsys.readouterr().err
    log = (site.folder / "runs/killed/slow/seed-0.log").read_text()
    assert log.count("\n== ") == 2 and "--resume" in log and "frames 3 to 6" in log, "from its checkpoint"
    assert by_name["killed"].metrics["psnr"] == 30.0 + 6 / 2.0


def test_a_second_start_does_only_what_is_missing(site, suite_of, run):
    suite = suite_of("room0", "refused")
    first = run(suite)
    before = {p: p.stat().st_mtime_ns for p in (site.folder / "runs/room0").rglob("metrics.json")}
    assert len(before) == 2 and first.count("failed") == 2
    larger = suite_of("room0", "refused", "room1")
    results = run(larger)
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert results.count("done") == 4
    counted = tries(site, larger)
    assert counted["room0/slow/seed-0"] == 1 and counted["refused/slow/seed-0"] == 4
    assert run(larger).count("done") == 4 and tries(site, larger)["room1/quick/seed-0"] == 1


def test_a_run_with_other_options_is_another_run(site, suite_of, run):
    suite = suite_of("room0")
    assert run(suite).mean("room0", "slow", "fps").value == 2.0
    changed = suite_of("room0", options={"preset": "fast"})
    assert known_record(site, changed.jobs()[0]).attempts == ()
    run(changed)
    log = (site.folder / "runs/room0/slow/seed-0.log").read_text()
    assert log.count("\n== ") == 2 and "--preset fast" in log and "--resume" not in log


def test_what_has_no_data_is_not_run_and_no_failure(site, suite_of, run):
    suite = suite_of("room0", "absent")
    (site.data / "absent").rmdir()
    results = run(suite)
    assert [r.status for r in results.runs if r.sequence == "absent"] == ["not run"] * 2
    assert all("absent is not under" in r.reason for r in results.runs if r.sequence == "absent")
    assert results.average("slow", "psnr") is None, "no average of what was not run"
    (site.data / "absent").mkdir()
    assert run(suite).count("done") == 4


def test_a_sequence_is_fetched_once_and_whole(site, suite_of, run):
    fetch = "sh -c 'echo {seq} >> {folder}/../fetched && echo x > {folder}/camera.json'"
    suite = suite_of("room0", "far", fetch=fetch, seeds=(0, 1, 2))
    (site.data / "far").rmdir()
    assert run(suite).count("done") == 12
    assert (site.data / "fetched").read_text() == "far\n"
    assert (site.data / "far/camera.json").read_text() == "x\n"
    assert not list(site.data.glob(".far*part"))
    broken = suite_of("room0", "gone", fetch="sh -c 'echo no such scan >&2; exit 3' {folder}")
    (site.data / "gone").rmdir()
    reasons = {r.reason for r in run(broken).runs if r.sequence == "gone"}
    assert reasons == {"fetching gone failed: no such scan"} and not (site.data / "gone").exists()


def test_a_stopped_suite_goes_on_where_it_was(site, suite_of):
    suite, display = suite_of("waiting", "room0"), open_display(Verbosity.QUIET)
    checkpoints = site.folder / "runs/waiting/slow/.seed-0.partial-1/checkpoints"

    class Interrupted(LocalPool):
        """As where the user presses Ctrl-C after the first run is done, while another one goes on."""

        def run(self, work, tasks):
            with contextlib.closing(super().run(work, tasks)) as loop:
                yield next(loop)
                while not checkpoints.is_dir():
                    time.sleep(0.01)
                raise KeyboardInterrupt

    saved: list[Results] = []
    with pytest.raises(KeyboardInterrupt):
        execute(suite, site, Interrupted(TWO, most=2), display, save=saved.append)
    assert saved[-1].count("failed") == 0 and saved[-1].count("done") >= 1
    assert known_record(site, suite.jobs()[0]).attempts[-1].exit_code == 143, "it was told to end"
    (site.folder / "go").touch()
    assert execute(suite, site, LocalPool(TWO, most=2), display).count("done") == 4
    log = (site.folder / "runs/waiting/slow/seed-0.log").read_text()
    assert "--resume" in log, "from its checkpoint"


def test_results_are_saved_on_the_way(site, suite_of, monkeypatch):
    monkeypatch.setattr("ggwarp.suite.execution._SAVED_EVERY", 0.0)
    saved: list[Results] = []
    execute(suite_of("room0"), site, LocalPool(TWO, most=1), open_display(Verbosity.QUIET), save=saved.append)
    assert [results.count("done") for results in saved] == [1, 2, 2]


def test_a_run_that_goes_on_without_its_worker_is_waited_for(site, suite_of, run):
    """As when a worker is lost and the run is not: two runs never write into one folder."""
    suite = suite_of("room0", settings=suite_of().settings[:1])
    left = site.folder / "runs/room0/slow/.seed-0.partial-7"
    left.mkdir(parents=True)
    lock = lock_folder(left)
    assert lock is not None
    results: list[Results] = []
    thread = threading.Thread(target=lambda: results.append(run(suite)))
    thread.start()
    time.sleep(0.7)
    assert tries(site, suite) == {"room0/slow/seed-0": 0}, "not begun"
    os.close(lock)
    thread.join(20.0)
    assert results and results[0].count("done") == 1


def test_a_folder_of_other_things_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(SuiteError, match="holds other files and no suite; name a new folder"):
        open_site(tmp_path, data=tmp_path)
    with pytest.raises(SuiteError, match="is no folder"):
        open_site(tmp_path / "thesis.tex", data=tmp_path)
    assert open_site(tmp_path / "new", data=tmp_path).mark == open_site(tmp_path / "new", data=tmp_path).mark


def test_a_machine_that_does_not_see_the_folder_says_so(site, suite_of, run):
    (site.folder / ".suite").write_text("another")
    [one, _] = run(suite_of("room0")).runs
    assert one.status == "failed" and "does not see this folder; give --out on storage" in one.reason


def test_a_machine_with_another_version_says_so(site, suite_of, run):
    site = dataclasses.replace(site, version="0.0.1")
    display = open_display(Verbosity.QUIET)
    [one, _] = execute(suite_of("room0"), site, LocalPool(TWO, most=1), display).runs
    assert "the suite was started with 0.0.1; install the same on all machines" in one.reason


def test_two_suites_in_one_folder_are_refused(site, suite_of, run):
    lock = lock_folder(site.folder)
    assert lock is not None
    with pytest.raises(SuiteError, match="another ggwarp suite is at work there; wait for it, or stop it"):
        run(suite_of("room0"))
    os.close(lock)
    assert run(suite_of("room0")).count("done") == 2


def test_a_run_that_somebody_removed_is_done_again(site, suite_of, run):
    suite = suite_of("room0")
    run(suite)
    shutil.rmtree(site.folder / "runs/room0/slow/seed-0")
    assert known_record(site, suite.jobs()[0]).status == "not run"
    assert run(suite).count("done") == 2 and tries(site, suite) == {
        "room0/slow/seed-0": 1, "room0/quick/seed-0": 1
    }  # fmt: skip
