# SPDX-License-Identifier: Apache-2.0
"""Live mode when something is amiss: a slow disk, a camera that stalls, a mapper that crashes."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from ggwarp import run
from ggwarp.datasets import reader
from ggwarp.io.trajectory import read_tum
from ggwarp.pipeline.mapping.mapper import Mapper
from ggwarp.results.saved_run import load_run

FRAMES = 6
COMMAND = [
    *("--seq", "office", "--device", "cpu", "--scale", "0.08", "--save-renders", "0", "--frames", "0:18:3"),
    *("--mapper.iterations", "2", "--gicp.points", "1500", "--out", "o"),
]
PACES = ["20", "uncapped"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def threads_end():
    """No thread that would keep the program from ending is left, nor the tracker's."""
    before = set(threading.enumerate())
    yield
    left = [t for t in set(threading.enumerate()) - before if not t.daemon or t.name == "ggwarp-tracking"]
    for one in left:
        if one.name.startswith("ggwarp-loops"):
            one.join(timeout=10.0)  # what the last frame shows may be looked for still
    left = [t for t in left if t.is_alive() and not t.name.startswith("ggwarp-launch")]
    assert [t.name for t in left] == []


def test_a_slow_disk_makes_frames_late_and_loses_none(monkeypatch, capsys) -> None:
    resized = reader.resized

    def slow(frame, camera):
        time.sleep(0.3)  # six times a frame's time
        return resized(frame, camera)

    monkeypatch.setattr(reader, "resized", slow)
    assert run.main([*COMMAND, "--fps", "20"]) == 0
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["frames"] == FRAMES and metrics["frames_lost"] == 0
    assert metrics["frames_late"] > 0 and metrics["late_ms_max"] > 1000.0, "the last one"
    assert "frames were taken up late" in capsys.readouterr().err


@pytest.mark.parametrize("pace", PACES)
def test_a_stalled_camera_is_waited_for_until_a_signal_comes(monkeypatch, capsys, pace: str) -> None:
    resized, answer = reader.resized, threading.Event()

    def stalled(frame, camera):
        if frame.index == 9:
            threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM)).start()
            answer.wait()
        return resized(frame, camera)

    monkeypatch.setattr(reader, "resized", stalled)
    try:
        assert run.main([*COMMAND, "--fps", pace]) == 143
    finally:
        answer.set()
    assert "interrupted after 3 of 6 frames; saved in o" in capsys.readouterr().out
    assert len(load_run("o").poses) == 3


@pytest.mark.parametrize("pace", PACES)
def test_a_mapper_that_crashes_ends_the_run_and_the_tracked_frames_are_saved(
    monkeypatch, capsys, pace: str
) -> None:
    insert, inserted = Mapper.observe_frame, []

    def crash(self, *arguments, **options):
        inserted.append(1)
        if len(inserted) == 4:
            raise RuntimeError("no device any more")
        return insert(self, *arguments, **options)

    monkeypatch.setattr(Mapper, "observe_frame", crash)
    assert run.main([*COMMAND, "--fps", pace]) == 1
    out, errors = capsys.readouterr()
    assert errors.splitlines()[-1] == "ggwarp: mapping failed at frame 9: RuntimeError: no device any more"
    frames = len(read_tum(Path("o/trajectory.txt"))[0])
    assert frames >= 4 and f"failed after {frames} of 6 frames; saved in o" in out
    assert len(load_run("o").gaussians) > 100
