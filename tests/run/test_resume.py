# SPDX-License-Identifier: Apache-2.0
"""A run that goes on ends with the bits of one that was never stopped, however it was stopped."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from fake_slam import only_line
from ggwarp import run
from ggwarp.checkpointing import KEPT_OF_THE_RECORD
from ggwarp.pipeline.slam import Slam
from ggwarp.results.checkpoints import checkpoint_files
from ggwarp.results.record import RunRecord
from ggwarp.results.run_folder import OUTPUTS

OPTIONS = ["--seq", "office", "--device", "cpu", "--scale", "0.08", "--save-renders", "0"]
METHOD = ["--mapper.iterations", "2", "--gicp.points", "1500"]
FRAMES, REFINE = ["--frames", "0:18:3"], ["--refine", "3"]
WHOLE = [*OPTIONS, *METHOD, *FRAMES, *REFINE]
TIMES = {
    "fps",
    "wall_s",
    "tracking_ms",
    "loop_ms",
    "mapping_ms",
    "refine_s",
    "latency_ms_p50",
    "latency_ms_p95",
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a checkpoint after every second frame, that was never stopped."""
    out = tmp_path_factory.mktemp("whole") / "o"
    assert run.main([*WHOLE, "--out", str(out), "--checkpoint-every", "2", "-q"]) == 0
    return out


@pytest.fixture
def copied(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(whole, "o")
    return Path("o")


def figures(folder: Path) -> dict[str, object]:
    metrics = json.loads((folder / "metrics.json").read_text())
    return {k: v for k, v in metrics.items() if k not in {*TIMES, "peak_memory_mb", "warnings"}}


def assert_same(one: Path, other: Path) -> None:
    for name in {*OUTPUTS} - {"metrics.json", "frames.csv", "report.html"}:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    assert figures(one) == figures(other)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_killed_run_goes_on_and_the_earlier_one_was_there(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "o")
    before = contents(tmp_path / "o")
    code = (
        "import os, sys\nfrom ggwarp import run, session\n"
        "take = session.Session._take\n"
        "def killed(self, frame, step):\n"
        "    take(self, frame, step)\n"
        "    if frame.index == 12: os.kill(os.getpid(), 9)\n"
        "session.Session._take = killed\n"
        "run.main(sys.argv[1:])\n"
    )
    arguments = [*WHOLE, "--out", "o", "--checkpoint-every", "2", "-q"]
    done = subprocess.run([sys.executable, "-c", code, *arguments], cwd=tmp_path, check=False)
    assert done.returncode == -signal.SIGKILL
    [left] = tmp_path.glob(".o.partial-*")
    assert len(checkpoint_files(left)) == 2 and contents(tmp_path / "o") == before
    assert run.main(["--resume", str(tmp_path / "o"), "-q"]) == 0
    assert_same(tmp_path / "o", whole)
    assert [p.name for p in tmp_path.iterdir()] == ["o"] and contents(tmp_path / "o") != before


def test_a_finished_run_goes_on_with_more_frames_and_refinement(whole: Path, tmp_path: Path) -> None:
    out = str(tmp_path / "o")
    assert run.main([*OPTIONS, *METHOD, "--frames", "0:9:3", "--out", out, "-q"]) == 0
    assert run.main(["--resume", out, *FRAMES, "-q"]) == 0
    assert run.main(["--resume", out, "--refine", "1", "-q"]) == 0
    assert figures(Path(out))["refine_iterations"] == 1
    assert run.main(["--resume", out, "--refine", "2", "--checkpoint-every", "off", "-q"]) == 0
    assert_same(Path(out), whole)


def test_an_older_checkpoint_is_as_good(whole: Path, copied: Path, capsys) -> None:
    newest, before = checkpoint_files(copied)
    newest.write_bytes(newest.read_bytes()[:-100])
    assert run.main(["--resume", "o"]) == 0
    said = "".join(capsys.readouterr())
    assert "is damaged" in said and "the checkpoint before it is taken" in said
    assert_same(copied, whole)
    for path in checkpoint_files(copied):
        path.write_bytes(b"nothing")
    before = contents(copied)
    assert run.main(["--resume", "o"]) == run.USER_ERROR
    assert "is damaged" in only_line(capsys) and contents(copied) == before


@pytest.mark.parametrize("pipelined", ["off", "on"])
def test_a_run_that_was_stopped_goes_on(whole: Path, tmp_path: Path, monkeypatch, pipelined: str) -> None:
    step, tracked_ahead = Slam.map_frame, threading.Event()
    track = Slam.track_frame

    def noted(self, frame):
        if frame.index == 9:
            tracked_ahead.set()
        return track(self, frame)

    def interrupted(self, tracked, waiting=None):
        if tracked.frame.index == 6:
            os.kill(os.getpid(), signal.SIGTERM)
        if tracked.frame.index == 3 and pipelined == "on":
            assert tracked_ahead.wait(60.0)  # so that frames are tracked that are not mapped
        return step(self, tracked, waiting)

    out = str(tmp_path / "o")
    with monkeypatch.context() as patch:
        patch.setattr(Slam, "track_frame", noted)
        patch.setattr(Slam, "map_frame", interrupted)
        assert run.main([*WHOLE, "--pipelined", pipelined, "--out", out, "-q"]) == 143
    frames = figures(Path(out))["frames"]
    assert frames == 3 if pipelined == "off" else frames > 3, "those that the tracker was ahead"
    assert run.main(["--resume", out, "--pipelined", "auto", "-q"]) == 0
    assert_same(Path(out), whole)


def test_two_threads_write_the_same_checkpoints(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "o"
    assert run.main([*WHOLE, "--pipelined", "on", "--checkpoint-every", "4", "--out", str(out), "-q"]) == 0
    checkpoint_files(out)[0].unlink()
    assert run.main(["--resume", str(out), "--pipelined", "auto", "-q"]) == 0
    assert_same(out, whole)


def test_a_failure_leaves_what_can_go_on(whole: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    step = Slam.map_frame

    def failing(self, tracked, waiting=None):
        if tracked.frame.index == 12:
            raise KeyboardInterrupt
        return step(self, tracked, waiting)

    with monkeypatch.context() as patch:
        patch.setattr(Slam, "map_frame", failing)
        assert run.main([*WHOLE, "--out", "o", "--checkpoint-every", "2"]) == 130
    assert "ggwarp run --resume o-incomplete goes on" in "".join(capsys.readouterr())
    assert run.main(["--resume", "o-incomplete", "-q"]) == 0
    assert_same(Path("o"), whole)
    assert not Path("o-incomplete").exists()


def test_a_step_that_was_broken_off_is_in_no_checkpoint(whole: Path, tmp_path: Path, monkeypatch) -> None:
    step, monotonic = Slam.map_frame, time.monotonic

    def broken(self, tracked, waiting=None):
        if tracked.frame.index == 12:
            self._mapper.insert(tracked.frame, tracked.result.T_wc)  # half of it
            os.kill(os.getpid(), signal.SIGTERM)
            monkeypatch.setattr(time, "monotonic", lambda: monotonic() + 60.0)
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self, tracked, waiting)

    out = tmp_path / "o"
    with monkeypatch.context() as patch:
        patch.setattr(Slam, "map_frame", broken)
        assert run.main([*WHOLE, "--out", str(out), "--checkpoint-every", "2", "-q"]) == 143
    assert figures(out)["frames"] == 4 and len(checkpoint_files(out)) == 2
    assert run.main(["--resume", str(out), "-q"]) == 0
    assert_same(out, whole)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ("--mapper.iterations 3", "--mapper.iterations: with --resume a run keeps what it began with"),
        ("--scale 0.1 --tracker ground-truth", "--tracker, --scale: with --resume"),
        ("--preset fast", "leave --config and --preset out"),
        ("--frames 0:4", "the run has 6 frames behind it, 0 to 15; give the frames that it began with"),
        ("--frames 1:30:3", "the run has 6 frames behind it"),
        ("--frames 0:30", "the run has 6 frames behind it"),
        ("--seq wall", "the sequence's camera|frame 0 of the sequence is not the one that it was"),
        ("--checkpoint-every soon", "--checkpoint-every 'soon': give"),
        ("--device cuda:7", "no such device"),
    ],
)
def test_what_cannot_change_is_refused_by_name(copied: Path, capsys, options: str, reason: str) -> None:
    before = contents(copied)
    assert run.main(["--resume", "o", *options.split(), "-q"]) == run.USER_ERROR
    assert re.search(reason, only_line(capsys))
    assert contents(copied) == before and [p.name for p in Path().iterdir()] == ["o"]


def test_all_of_the_record_is_kept_or_follows() -> None:
    of_the_start = {"sequence", "dataset", "device", "monocular", "class_names", "plan"}
    of_the_end = {"live", "counts", "failure", "failures", "interrupted", "evaluation"}
    names = {field.name for field in dataclasses.fields(RunRecord)}
    assert names == {*KEPT_OF_THE_RECORD, "reports"} | of_the_start | of_the_end


def test_results_may_go_elsewhere(whole: Path, copied: Path) -> None:
    before = contents(copied)
    checkpoint_files(copied)[0].unlink()
    del before[f"checkpoints/{checkpoint_files(whole)[0].name}"]
    assert run.main(["--resume", "o", "--out", "p", "-q"]) == 0
    assert_same(Path("p"), whole)
    assert contents(copied) == before


def test_a_disk_without_room_is_told_once(whole: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    def full(path, tree):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("ggwarp.results.checkpoints.write_checkpoint", full)
    out = tmp_path / "o"
    assert run.main([*WHOLE, "--out", str(out), "--checkpoint-every", "1", "-q"]) == 0
    said = "".join(capsys.readouterr())
    assert said.count("no checkpoint: ") == 1 and "No space left on device; the run goes on" in said
    assert_same(out, whole)
    assert run.main(["--resume", str(out)]) == run.USER_ERROR
    assert "has no checkpoint" in only_line(capsys)


@pytest.mark.parametrize("side", ["tracking_state", "mapping_state"])
def test_a_state_that_cannot_be_had_costs_the_checkpoint_alone(
    whole: Path, tmp_path: Path, monkeypatch, capsys, side: str
) -> None:
    def none_left(self):
        raise MemoryError

    monkeypatch.setattr(f"ggwarp.pipeline.slam.Slam.{side}", none_left)
    out = tmp_path / "o"
    assert run.main([*WHOLE, "--out", str(out), "--checkpoint-every", "1", "-q"]) == 0
    said = "".join(capsys.readouterr())
    assert said.count("no checkpoint: MemoryError; the run goes on") == 1
    assert_same(out, whole)
