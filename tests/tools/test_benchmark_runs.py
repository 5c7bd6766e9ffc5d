# SPDX-License-Identifier: Apache-2.0
"""tools/benchmark.py: whole runs, and what is made of them."""

import json
import time
from pathlib import Path

import pytest

import benchmark
from benchmarking import system
from benchmarking.options import check_out, new_record
from benchmarking.runs import Outcome, RunSpec, execute
from benchmarking.timed_run import Clock
from ggwarp.config.command_line import parse

METRICS = {"frames": 20, "fps": 4.0, "mapping_iterations": 200, "psnr": 30.0, "dataset": "replica"}


def test_a_run_s_options_are_the_command_s(tmp_path: Path):
    spec = RunSpec("room0", "fast", "30", "0:8", 0.5, tmp_path, "cpu")
    config = parse(spec.arguments(tmp_path / "out")).run
    assert (config.seq, config.preset, config.fps, config.frames) == ("room0", "fast", 30.0, "0:8")
    assert (config.scale, config.data, config.device) == (0.5, tmp_path, "cpu")
    assert config.slam.mapper.iterations < parse(["--seq", "room0"]).run.slam.mapper.iterations, (
        "the preset's own"
    )
    assert parse(RunSpec("room0").arguments(tmp_path)).run.fps is None


def test_shares_are_of_the_loop_s_time():
    outcome = Outcome(METRICS, {"tracking": 1.0, "insertion": 0.5, "mapping": 2.5})
    assert outcome.loop_s == 5.0
    assert outcome.shares == pytest.approx({"tracking": 0.2, "insertion": 0.1, "mapping": 0.5, "rest": 0.2})
    assert Outcome({"frames": 0, "fps": None}).shares == {"rest": None}


def test_a_clock_counts_nested_calls_once():
    clock = Clock()
    inner = clock.around(lambda: time.sleep(0.02))
    outer = clock.around(lambda: (inner(), inner()))
    started = time.perf_counter()
    outer()
    passed = time.perf_counter() - started
    assert 0.04 <= clock.seconds <= passed
    assert clock.around(lambda x: x + 1)(2) == 3


def test_speed_and_quality_of_a_run_say_what_it_ran_on():
    frames = [{"late_ms": 0.0}, {"late_ms": 10.0}]
    outcome = Outcome(METRICS | {"dataset": "synthetic"}, {"mapping": 1.0}, frames)
    row = system.speed_row(RunSpec("office0"), outcome)
    assert row["sequence"] == "office0 (built-in)" and row["a frame"] == 10.0 and row["FPS"] == 4.0
    assert system.stage_row(RunSpec("office0"), outcome)["late max ms"] is None, "not live"
    assert system.stage_row(RunSpec("office0", fps="5"), outcome)["late max ms"] == 10.0
    assert system.quality_row(RunSpec("office0"), outcome)["LPIPS"] is None


def test_the_course_of_a_run_is_told_in_quarters():
    frames = [
        {"index": k, "tracking_ms": float(k), "mapping_ms": 20.0, "mapping_iterations": 4.0 * (k < 6),
         "late_ms": 0.0, "gaussians": 100.0 * k}
        for k in range(8)
    ]  # fmt: skip
    rows = system.course_rows(RunSpec("room0"), Outcome(METRICS, {}, frames))
    assert [row["frames"] for row in rows] == ["0-1", "2-3", "4-5", "6-7"]
    assert [row["tracking ms"] for row in rows] == [0.5, 2.5, 4.5, 6.5]
    assert [row["mapping ms an iteration"] for row in rows] == [5.0, 5.0, 5.0, None]
    assert rows[-1]["Gaussians"] == 700
    assert len(system.course_rows(RunSpec("room0"), Outcome(METRICS, {}, frames[:2]))) == 2


def test_live_runs_are_held_against_their_pace_and_the_synchronous_run():
    plain, live = RunSpec("redkitchen", "fast"), RunSpec("redkitchen", "fast", "5")
    frames = [{"late_ms": 0.0}, {"late_ms": 500.0}]
    outcomes = {plain: Outcome(METRICS), live: Outcome(METRICS | {"psnr": 29.2}, {}, frames)}
    speed = system.checks(plain, outcomes[plain], outcomes, True)
    assert [(c.value, c.target, c.met) for c in speed] == [(4.0, 10.0, False)]
    assert not system.checks(RunSpec("room0", "fast"), outcomes[plain], outcomes, True)
    late, loss = system.checks(live, outcomes[live], outcomes, True)
    assert late.value == pytest.approx(0.5) and late.target == 0.4 and late.met is False
    assert loss.value == pytest.approx(0.8) and loss.target == 0.5 and loss.met is False


def test_a_run_is_clocked_and_read(capfd: pytest.CaptureFixture[str]):
    outcome = execute(RunSpec("office", frames="0:3", scale=0.05, device="cpu"))
    assert not outcome.failure
    assert outcome.metrics["frames"] == 3 and len(outcome.late_ms) == 3
    assert all(seconds > 0.0 for seconds in outcome.stages.values())
    assert set(outcome.stages) == {"tracking", "insertion", "mapping"}
    shares = [s for s in outcome.shares.values() if s is not None]
    assert sum(shares) == pytest.approx(1.0)
    # The run's own figure holds the clocked calls, and little else.
    own = outcome.metrics["tracking_ms"] * 3 / 1e3
    assert outcome.stages["tracking"] <= 1.001 * own
    assert "running office" in capfd.readouterr().err


def test_a_run_that_fails_is_noted_and_the_rest_goes_on(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    out = tmp_path / "s.json"
    arguments = ["system", "--seq", "nowhere", "--device", "cpu", "--data", str(tmp_path), "--out", str(out)]
    assert benchmark.main(arguments) == 0
    content = json.loads(out.read_text())
    assert content["benchmark"] == "system" and content["settings"]["seq"] == ["nowhere"]
    assert any("nowhere" in note and "exit code 2" in note for note in content["notes"])
    assert "written" in capfd.readouterr().out


def test_a_mistake_ends_in_one_line(capsys: pytest.CaptureFixture[str]):
    assert benchmark.main(["kernels", "--size", "huge"]) == 2
    assert benchmark.main(["tracking", "--device", "cuda:77"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2 and all(line.startswith("benchmark: --") for line in lines)


def test_a_record_s_place_is_looked_at_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").touch()
    for path, said in ((tmp_path, "is a folder"), (tmp_path / "file" / "a.json", "lies in a file")):
        assert benchmark.main(["system", "--out", str(path)]) == 2
        assert said in capsys.readouterr().err
    check_out(tmp_path / "new" / "a.json")
    record = new_record("system", system.SystemOptions(out=tmp_path / "a.json", data=tmp_path))
    assert str(tmp_path) not in str(record.settings)
