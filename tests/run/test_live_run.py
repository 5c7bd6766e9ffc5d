# SPDX-License-Identifier: Apache-2.0
"""A run of frames that come once: it ends where they do, and says how many were lost on the way."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import ggwarp
from ggwarp import run
from ggwarp.datasets.live.sequence import LiveSequence
from ggwarp.results.saved_run import load_run
from ggwarp.results.staging import StagedFolder
from live_frames import sent


def piped(monkeypatch: pytest.MonkeyPatch, data: bytes) -> None:
    pipe = SimpleNamespace(buffer=io.BytesIO(data), isatty=lambda: False)
    monkeypatch.setattr(sys, "stdin", pipe)


def test_a_run_of_a_stream(scene, fake, tmp_path, capsys, monkeypatch):
    piped(monkeypatch, sent(4))
    monkeypatch.setattr(LiveSequence, "dropped", property(lambda self: 7))
    assert run.main(["--seq", "-", "--device", "cpu", "--out", str(tmp_path / "live")]) == 0
    told = capsys.readouterr()
    text = told.out + told.err
    assert "live frames on cpu at 80x60" in text and "frames on standard input, as they come" in text
    assert "7 pictures of the camera came too fast and were dropped" in text
    metrics = json.loads((tmp_path / "live/metrics.json").read_text())
    assert metrics["frames"] == 4 and metrics["dataset"] == "stream"
    assert metrics["plan"]["dropped"] == 7 and "1048576" not in text


def test_a_stream_without_a_frame_is_refused(scene, fake, tmp_path, capsys, monkeypatch):
    piped(monkeypatch, sent(0))
    assert run.main(["--seq", "-", "--device", "cpu", "--out", str(tmp_path / "live")]) == 2
    assert "stream: no frame could be used; the first: none came" in capsys.readouterr().err
    assert not (tmp_path / "live").exists()


@pytest.mark.parametrize("pace", [(), ("--fps", "uncapped")], ids=["in turn", "uncapped"])
def test_what_a_killed_run_had_by_then_is_kept(tmp_path, pace):
    out = tmp_path / "live"
    command = [*(sys.executable, "-m", "ggwarp", "run", "--seq", "-", "--device", "cpu", "--preset", "fast")]
    command += ["--checkpoint-every", "2", "--out", str(out), *pace]
    environment = {**os.environ, "PYTHONPATH": str(Path(ggwarp.__file__).parents[1])}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment
    ) as killed:
        assert killed.stdin is not None and killed.stderr is not None
        killed.stdin.write(sent(5))
        killed.stdin.flush()  # and no end: the camera goes on
        while not list(tmp_path.glob(".live.partial-*/objects.json")):  # which comes after the map
            assert killed.poll() is None, killed.stderr.read()
            time.sleep(0.05)
        killed.kill()
    left = next(tmp_path.glob(".live.partial-*"))
    assert len(load_run(left).poses) >= 2 and len(load_run(left).gaussians) > 100
    kept = StagedFolder(out, "stream").create()
    assert kept == {left: tmp_path / "live-incomplete"}, "the next run's first deed"
    assert len(load_run(tmp_path / "live-incomplete").gaussians) > 100
