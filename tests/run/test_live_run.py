# SPDX-License-Identifier: Apache-2.0
"""A run of frames that come once: it ends where they do, and says how many were lost on the way."""

from __future__ import annotations

import io
import json
import sys
from types import SimpleNamespace

import pytest

from ggwarp import run
from ggwarp.datasets.live.sequence import LiveSequence
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
