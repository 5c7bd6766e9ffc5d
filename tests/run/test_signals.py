# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, SIGTERM and SIGHUP: what there is is saved, whatever the run is doing."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from fake_slam import FRAMES, only_line
from ggwarp import interruption, run, session
from ggwarp.datasets import reader
from ggwarp.io.trajectory import read_tum
from ggwarp.results import run_folder


def test_ctrl_c_ends_the_refinement_only(scene, fake, monkeypatch, capsys):
    def interrupt(done):
        if done == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(fake, "on_refine", staticmethod(interrupt))
    assert run.main(["--seq", "room9", "--device", "cpu", "--refine", "50", "--out", "o"]) == 0
    assert "refinement ended after 3 of 50 iterations" in capsys.readouterr().out
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["refine_iterations"] == 3 and metrics["psnr"] is not None


@pytest.mark.parametrize("pipelined", ["on", "off"])
def test_ctrl_c_saves_what_there_is(scene, fake, monkeypatch, capsys, pipelined):
    def interrupt(index):
        if index == 2:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(fake, "on_map", staticmethod(interrupt))
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o", "--pipelined", pipelined]) == 130
    metrics = json.loads(Path("o/metrics.json").read_text())
    frames = metrics["frames"]
    assert frames == 3 or (pipelined == "on" and 3 <= frames <= FRAMES), "frames tracked ahead are kept"
    assert f"interrupted after {frames} of 6 frames; saved in o" in capsys.readouterr().out
    assert (
        metrics["mapping_iterations"] == 3 * 3
        and metrics["ate_rmse_cm"] is not None
        and metrics["psnr"] is None
    )
    assert set(run_folder.OUTPUTS) <= {p.name for p in Path("o").iterdir()}
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=lambda n: n.name)
@pytest.mark.parametrize("moment", ["mapping", "refining", "saving", "evaluating"])
def test_a_signal_saves_what_there_is(scene, fake, monkeypatch, capsys, moment, number):
    def ask(*arguments):
        os.kill(os.getpid(), number)
        if moment == "saving":
            os.kill(os.getpid(), signal.SIGINT)

    def asking(original):
        return lambda *arguments: (ask(), original(*arguments))[1]

    if moment == "saving":
        monkeypatch.setattr(run_folder, "write_ply_parts", asking(run_folder.write_ply_parts))
    else:
        name = {"mapping": "on_map", "refining": "on_refine", "evaluating": "render"}[moment]
        wrapped = asking(getattr(fake, name))
        monkeypatch.setattr(fake, name, wrapped if name == "render" else staticmethod(wrapped))
    before = [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)]
    command = ["--seq", "room9", "--device", "cpu", "--out", "o", "--refine", "5"]
    assert run.main(command) == 128 + number
    assert [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)] == before
    metrics = json.loads(Path("o/metrics.json").read_text())
    frames = 1 if moment == "mapping" else FRAMES
    assert f"interrupted after {frames} of 6 frames; saved in o" in capsys.readouterr().out
    assert metrics["frames"] == frames and metrics["psnr"] is None
    assert metrics["refine_iterations"] == {"mapping": 0, "refining": 1}.get(moment, 5)
    assert set(run_folder.OUTPUTS) <= {p.name for p in Path("o").iterdir()}


@pytest.mark.parametrize("pipelined", ["on", "off"])
def test_a_signal_ends_the_wait_for_a_frame(scene, fake, monkeypatch, capsys, pipelined):
    """The fourth frame never comes."""
    resized, answer = reader.resized, threading.Event()

    def stalled(frame, camera):
        if frame.index == 3:
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
            answer.wait()
        return resized(frame, camera)

    monkeypatch.setattr(reader, "resized", stalled)
    started = time.monotonic()
    try:
        command = ["--seq", "room9", "--device", "cpu", "--out", "o", "--pipelined", pipelined]
        assert run.main(command) == 143
    finally:
        answer.set()
    assert time.monotonic() - started < 5.0
    assert "interrupted after 3 of 6 frames; saved in o" in capsys.readouterr().out
    assert len(read_tum(Path("o/trajectory.txt"))[0]) == 3


def test_a_signal_before_the_first_frame_leaves_no_trace(scene, fake, monkeypatch, capsys):
    monkeypatch.setattr(session, "load_kernels", lambda *_: os.kill(os.getpid(), signal.SIGHUP))
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 129
    assert only_line(capsys) == "ggwarp: interrupted; nothing was saved"
    assert {p.name for p in Path().iterdir()} == {"data"}


@pytest.mark.parametrize("moment", ["on_track", "on_map", "on_refine"])
def test_a_step_that_does_not_end_is_left_and_the_rest_is_saved(scene, fake, monkeypatch, capsys, moment):
    """The signal comes again when its patience is over."""
    monkeypatch.setattr(interruption, "_PATIENCE", 0.05)
    done = []

    def hang(number):
        done.append(number)
        if len(done) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.1)
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)

    monkeypatch.setattr(fake, moment, staticmethod(hang))
    started = time.monotonic()
    command = ["--seq", "room9", "--device", "cpu", "--out", "o", "--refine", "5", "--pipelined", "off"]
    assert run.main(command) == 143
    assert time.monotonic() - started < 30.0
    frames = FRAMES if moment == "on_refine" else 2
    assert f"interrupted after {frames} of 6 frames; saved in o" in capsys.readouterr().out
    assert len(read_tum(Path("o/trajectory.txt"))[0]) == frames and Path("o/map.ply").is_file()
