# SPDX-License-Identifier: Apache-2.0
"""Runs that fail on the way: the earlier run is left alone, and what there is is saved."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest

from fake_slam import FRAMES, only_line
from ggwarp import run, saving, session
from ggwarp.io.ply import read_ply
from ggwarp.io.trajectory import read_tum
from ggwarp.results import run_folder, staging
from ggwarp.results.saved_run import load_run


def _run_once(capsys) -> dict[str, bytes]:
    """Make a run in ``o`` and return its files."""
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    capsys.readouterr()
    return {p.name: p.read_bytes() for p in Path("o").iterdir() if p.is_file()}


def test_an_earlier_run_outlives_a_refusal(scene, fake, monkeypatch, capsys):
    before = _run_once(capsys)
    monkeypatch.setattr(fake, "sequential_only", True)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o", "--pipelined", "on"]) == 2
    for path in (scene / "results").glob("frame*.jpg"):
        path.write_bytes(b"")
    assert run.main(["--seq", "room9", "--device", "cpu", "--frames", "2:4", "--out", "o"]) == 2
    assert before == {p.name: p.read_bytes() for p in Path("o").iterdir() if p.is_file()}
    assert {p.name for p in Path().iterdir()} == {"data", "o"}


def test_a_run_that_cannot_take_its_place_is_kept_under_its_own_name(scene, fake, monkeypatch, capsys):
    before = _run_once(capsys)

    def busy(new, target):
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(target))

    with monkeypatch.context() as patched:
        patched.setattr(staging, "_exchange", busy)
        assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 1
    assert before == {p.name: p.read_bytes() for p in Path("o").iterdir() if p.is_file()}
    assert "the rest is in o-incomplete" in capsys.readouterr().out
    assert len(read_tum(Path("o-incomplete/trajectory.txt"))[0]) == FRAMES
    _run_once(capsys)
    assert Path("o-incomplete/map.ply").is_file(), "the next run into the same folder leaves it"


def test_a_folder_of_other_files_is_left_alone(scene, fake, capsys):
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "data"]) == 2
    assert only_line(capsys).startswith("ggwarp: data: holds other files and no run")
    assert [p.name for p in Path("data").iterdir()] == ["Replica"]


def test_a_file_in_the_place_of_the_renders(scene, fake, capsys):
    Path("o").mkdir()
    Path("o/renders").write_text("mine")
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 1
    assert "saving renders failed: " in only_line(capsys)
    assert Path("o/renders").read_text() == "mine" and len(load_run("o").poses) == FRAMES


@pytest.mark.parametrize("part", ["evaluation", "saving renders"])
def test_what_follows_the_saving_may_fail_alone(scene, fake, monkeypatch, capsys, part):
    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "here")

    name = {"evaluation": "compare", "saving renders": "RenderWriter"}[part]
    monkeypatch.setattr(session if name == "compare" else saving, name, full)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 1
    out, errors = capsys.readouterr()
    assert errors == f"ggwarp: {part} failed: here: No space left on device\n"
    assert out.splitlines()[-1] == "1 part failed; the rest is in o"
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["failures"] == [f"{part} failed: here: No space left on device"]
    assert (metrics["psnr"] is None) == (part == "evaluation") and metrics["ate_rmse_cm"] is not None
    assert len(read_ply(Path("o/map.ply"))) == 7 and len(load_run("o").poses) == FRAMES
    assert set(run_folder.OUTPUTS) <= {p.name for p in Path("o").iterdir()}


def test_a_map_that_has_no_principal_components_is_saved(scene, fake, monkeypatch, capsys):
    """NaN identities."""
    whole = fake.map_arrays

    def broken(slam):
        arrays = whole(slam)
        arrays.identities[:] = np.nan
        return arrays

    monkeypatch.setattr(fake, "map_arrays", broken)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 1
    assert "saving renders failed: LinAlgError" in capsys.readouterr().err.splitlines()[-1]
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["psnr"] is not None and len(metrics["failures"]) == 1 and Path("o/map.ply").is_file()


@pytest.mark.parametrize("pipelined", ["on", "off"])
@pytest.mark.parametrize("side", ["tracking", "mapping"])
def test_a_failure_says_its_reason_and_saves_what_there_is(scene, fake, monkeypatch, capsys, side, pipelined):
    def broken(index):
        if index == 3:
            raise ZeroDivisionError("one over nothing")

    monkeypatch.setattr(fake, {"tracking": "on_track", "mapping": "on_map"}[side], staticmethod(broken))
    command = ["--seq", "room9", "--device", "cpu", "--out", "o", "--refine", "5", "--pipelined", pipelined]
    assert run.main(command) == 1
    out, errors = capsys.readouterr()
    assert "in broken" in errors, "a bug is not hidden"
    assert errors.splitlines()[-1] == (
        f"ggwarp: {side} failed at frame 3: ZeroDivisionError: one over nothing"
    )
    metrics = json.loads(Path("o/metrics.json").read_text())
    frames = metrics["frames"]
    assert frames == 3 if side == "tracking" else 4 <= frames <= FRAMES
    assert out.splitlines()[-1] == f"failed after {frames} of 6 frames; saved in o"
    assert metrics["mapping_iterations"] == 3 * 3 and metrics["refine_iterations"] == 0
    assert metrics["psnr"] is None and len(read_ply(Path("o/map.ply"))) == 7
    assert set(run_folder.OUTPUTS) <= {p.name for p in Path("o").iterdir()}


def test_a_failed_refinement_keeps_the_map(scene, fake, monkeypatch, capsys):
    def broken(done):
        raise ZeroDivisionError

    monkeypatch.setattr(fake, "on_refine", staticmethod(broken))
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o", "--refine", "5"]) == 1
    assert "refinement failed at iteration 0: ZeroDivisionError" in capsys.readouterr().err.splitlines()[-1]
    assert len(read_ply(Path("o/map.ply"))) == 7


def test_a_map_that_cannot_be_had_leaves_the_trajectory_and_the_first_reason(
    scene, fake, monkeypatch, capsys
):
    def broken(index):
        raise ZeroDivisionError("the first reason")

    def gone(slam):
        raise RuntimeError("no device any more")

    monkeypatch.setattr(fake, "on_map", staticmethod(broken))
    monkeypatch.setattr(fake, "map_arrays", gone)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ggwarp: ")]
    assert "the first reason" in said[0] and "no device any more" in said[1]
    assert json.loads(Path("o/metrics.json").read_text())["gaussians"] is None
    assert len(read_tum(Path("o/trajectory.txt"))[0]) == 1


def test_a_disk_that_goes_away_needs_no_traceback(scene, fake, monkeypatch, capsys):
    def gone(index):
        raise OSError(errno.EIO, os.strerror(errno.EIO), "frame000001.jpg")

    monkeypatch.setattr(fake, "on_track", staticmethod(gone))
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 1
    assert "Input/output error" in only_line(capsys)
