# SPDX-License-Identifier: Apache-2.0
"""The command's manners, with a stand-in for the SLAM system: what it says, leaves and returns."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from fake_slam import FRAMES, only_line
from ggwarp import config, preparation, run
from ggwarp.config.options import option_table
from ggwarp.datasets.kept_frames import KeptFrames
from ggwarp.geometry.camera import Camera
from ggwarp.io.ply import read_ply
from ggwarp.io.trajectory import read_tum
from ggwarp.report.gallery import KINDS
from ggwarp.results import run_folder
from ggwarp.results.saved_run import load_run
from ggwarp.types import Frame


def test_a_run_leaves_its_folder(scene, fake, tmp_path, capsys):
    assert run.main(["--seq", "room9", "--scale", "0.5", "--device", "cpu", "--save-renders", "4"]) == 0
    out = capsys.readouterr().out
    assert "6 frames on cpu at 32x24 (--scale 0.5 of 64x48)" in out and "psnr " in out
    folder = tmp_path / "runs" / "latest"
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    pictures = {
        f"renders/frame{i:06d}_{w}.png" for i in (0, 4) for w in ("rgb", "depth", "objects", "features")
    }
    # What people look at: the first frames that they are spread over, and object 4.
    seen = {f"pictures/frame{i:06d}_{w}.jpg" for i in range(6) for w in KINDS} | {"pictures/object000004.jpg"}
    assert files == pictures | seen | set(run_folder.OUTPUTS)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["sequence"] == "room9" and metrics["dataset"] == "replica" and metrics["device"] == "cpu"
    assert metrics["frames"] == FRAMES and metrics["heldout_frames"] == FRAMES - 2
    assert metrics["ate_rmse_cm"] == pytest.approx(0.0, abs=1e-6) and metrics["miou"] == 1.0
    assert metrics["depth_l1_cm"] == pytest.approx(0.0, abs=1e-4) and metrics["psnr"] > 5.0
    stamps, poses = read_tum(folder / "trajectory.txt")
    assert len(stamps) == FRAMES and poses[5, 0, 3] == pytest.approx(0.5)
    assert len(read_ply(folder / "map.ply")) == 7
    depth = cv2.imread(str(folder / "renders/frame000004_depth.png"), cv2.IMREAD_UNCHANGED)
    assert depth is not None and depth.shape == (24, 32) and (depth == 2000).all()
    saved = load_run(folder)
    assert saved.objects[0].count == 4 and saved.camera == Camera(32, 24, 25.0, 25.0, 15.5, 11.5)


def test_its_configuration_runs_again(scene, fake, tmp_path):
    assert run.main(["--seq", "room9", "--device", "cpu", "--frames", "1:5:2", "--out", "one"]) == 0
    saved = config.load_config(Path("one/config.toml"))
    assert saved.device == "cpu" and saved.scale == 1.0 and saved.out is None
    assert run.main(["--config", "one/config.toml", "--out", "two", "--mapper.iterations", "5"]) == 0
    again = config.load_config(Path("two/config.toml"))
    assert again.frames == "1:5:2" and again.slam.mapper.iterations == 5
    rows = list(csv.DictReader(Path("two/frames.csv").open(newline="")))
    assert [r["index"] for r in rows] == ["1", "3"]
    assert Path("two/renders/frame000003_rgb.png").is_file()  # numbered as in the sequence
    assert not Path("runs").exists()


def test_live_modes_have_their_schedulers(scene, fake, monkeypatch):
    made = []
    monkeypatch.setattr(
        preparation, "LiveScheduler", lambda fps, frames: made.append(fps) or SimpleNamespace()
    )
    monkeypatch.setattr(
        preparation, "UncappedScheduler", lambda: made.append("uncapped") or SimpleNamespace()
    )
    for fps in ("30", "uncapped"):
        assert run.main(["--seq", "room9", "--device", "cpu", "--fps", fps, "--out", "o"]) == 0
        assert run.main(["--config", "o/config.toml", "--out", "again"]) == 0
    assert made == [30.0, 30.0, "uncapped", "uncapped"]


def test_refinement_is_counted(scene, fake):
    assert run.main(["--seq", "room9", "--device", "cpu", "--refine", "5", "--out", "o"]) == 0
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["refine_iterations"] == 5 and metrics["refine_s"] > 0.0
    assert metrics["mapping_iterations"] == 3 * FRAMES, "refinement is not part of the frames' mapping"


def test_a_tracker_that_works_in_turn(scene, fake, monkeypatch, capsys):
    monkeypatch.setattr(fake, "sequential_only", True)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o", "--pipelined", "on"]) == 2
    assert "--pipelined on: here tracking looks at the Gaussians" in capsys.readouterr().err.splitlines()[-1]


def test_bad_frames_are_skipped_and_counted(scene, fake, capsys):
    (scene / "results" / "frame000002.jpg").write_bytes(b"not a picture")
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    assert "frame 2 skipped: " in only_line(capsys)
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["frames"] == FRAMES - 1 and metrics["frames_skipped"] == 1
    rows = list(csv.DictReader(Path("o/frames.csv").open(newline="")))
    assert rows[2]["verdict"] == "skipped" and "frame000002.jpg" in rows[2]["reason"]


def test_only_bad_frames(scene, fake, capsys):
    for path in (scene / "results").glob("frame*.jpg"):
        path.write_bytes(b"")
    assert run.main(["--seq", "room9", "--device", "cpu", "--frames", "2:4", "--out", "o"]) == 2
    assert "Traceback" not in (err := capsys.readouterr().err) and err.splitlines()[-1].startswith("ggwarp: ")


def test_frames_are_read_again_when_too_many_to_hold(scene, fake, monkeypatch):
    def nothing(self, frame):
        assert isinstance(frame, Frame)

    monkeypatch.setattr(KeptFrames, "keep", nothing)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    assert json.loads(Path("o/metrics.json").read_text())["heldout_frames"] == FRAMES - 2


def test_the_office_says_that_it_is_not_the_real_one(fake, capsys):
    assert (
        run.main(["--seq", "office0", "--device", "cpu", "--frames", "0:2", "--scale", "0.1", "--out", "o"])
        == 0
    )
    out = capsys.readouterr().out
    assert "built-in synthetic office" in out and "ggwarp download replica office0" in out
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["dataset"] == "synthetic" and metrics["sequence"] == "office0"


MISTAKES = [
    ([], "--seq is missing"),
    (["--seq", "nothing"], "nothing: no such sequence"),
    (["--seq", "./no/folder"], "no/folder"),
    (["--seq", "room9", "--data", "absent"], "--data absent: no such folder"),
    (["--seq", "room9", "--device", "cuda:77"], "--device cuda:77: no such device"),
    (
        ["--seq", "room9", "--device", "cpu", "--frames", "9:12"],
        "--frames 9:12: no frame left; the sequence has 6",
    ),
    (["--seq", "room9", "--frames", "abc"], "--frames abc: expected"),
    (["--seq", "room9", "--scale", "0"], "--scale 0"),
    (["--seq", "room9", "--scale", "big"], "--scale"),
    (["--seq", "room9", "--fps", "fast"], "--fps"),
    (["--seq", "room9", "--refine", "-1"], "--refine -1: give 0 or a positive number"),
    (["--seq", "room9", "--pipelined", "perhaps"], "--pipelined"),
    (["--seq", "room9", "--device", "cpu", "--scale", "0.1"], "--scale 0.1: images of 6x5 are too small"),
    (["--seq", "room9", "--masks", "absent"], "absent"),
    (["--seq", "room9", "--device", "cpu", "--built-in.exposure-drift", "0.2"], "room9 is a recording"),
    (["--seq", "room9", "--preset", "mono"], "no such preset"),
    (["--seq", "room9", "--preset", "best"], "no such preset"),
    (["--seq", "room9", "--config", "absent.toml"], "absent.toml: no such file"),
    (["--seq", "room9", "--config", "a", "--preset", "fast"], "give one of them"),
    (["--seq", "room9", "--device", "cpu", "--out", "data/Replica/room9/traj.txt"], "traj.txt"),
    (["--seq", "room9", "--mapper.iteration", "3"], "--mapper.iteration"),
    (["--seq", "room9", "--unheard-of"], "--unheard-of"),
]


@pytest.mark.parametrize(
    ("arguments", "message"), MISTAKES, ids=[" ".join(a) or "nothing" for a, _ in MISTAKES]
)
def test_a_mistake_ends_in_one_line(scene, fake, capsys, arguments, message):
    assert run.main(arguments) == 2
    line = only_line(capsys)
    assert line.startswith("ggwarp: ") and message in line


@pytest.mark.parametrize("told", [True, False])
def test_without_depth_the_run_is_monocular(scene, fake, capsys, told):
    if not told:
        for path in (scene / "results").glob("depth*"):
            path.unlink()
    arguments = ["--seq", "room9", "--device", "cpu", "--out", "o", "--mapper.iterations", "3"]
    assert run.main([*arguments, "--mono"] if told else arguments) == 0
    assert "no depth: tracking by colour alone" in capsys.readouterr().out
    used = config.load_config(Path("o/config.toml"))
    assert used.slam.mono and used.slam.tracker == "photometric" and not used.slam.use_identity
    assert used.slam.mapper.iterations == 3, "what is given stays"
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["alignment"] == "sim3" and metrics["scale"] == pytest.approx(1.0)
    assert metrics["depth_l1_cm"] is None and metrics["psnr"] is not None


def test_a_film_of_an_unknown_camera_says_what_to_give(fake, tmp_path, capsys):
    film = cv2.VideoWriter(str(tmp_path / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    film.write(np.zeros((48, 64, 3), np.uint8))
    film.release()
    assert run.main(["--seq", "./walk.avi", "--device", "cpu"]) == 2
    assert "give --intrinsics FX FY CX CY" in only_line(capsys)


def test_an_empty_sequence(scene, fake, capsys):
    for path in (scene / "results").iterdir():
        path.unlink()
    assert run.main(["--seq", "room9", "--device", "cpu"]) == 2
    assert "empty" in only_line(capsys)


def test_as_a_program(tmp_path):
    """A mistake seen from outside, where Warp's own words would show too."""
    done = subprocess.run(
        [sys.executable, "-m", "ggwarp.run", "--seq", "nothing"], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and "nothing: no such sequence" in done.stderr
    assert list(tmp_path.iterdir()) == []
    shown = subprocess.run([sys.executable, "-m", "ggwarp.run", "--help"], capture_output=True, text=True)
    assert shown.returncode == 0 and len(shown.stdout.splitlines()) <= 60
    options = "seq data masks out device preset tracker frames scale fps pipelined refine save-renders config"
    for option in options.split():
        assert f"--{option} " in shown.stdout
    assert shown.stdout.count("ggwarp run --seq") == 3, "three examples come first"
    everything = subprocess.run(
        [sys.executable, "-m", "ggwarp.run", "--help-all"], capture_output=True, text=True
    )
    assert everything.returncode == 0
    for option in option_table():
        assert f"{option.flag} " in everything.stdout or f"{option.flag}," in everything.stdout


def test_quiet_says_little(scene, fake, capsys):
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o", "-q"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("frames ") and lines[-1] == "results in o"
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o", "-v"]) == 0
    assert any(line.startswith("frames: 3/6, ") for line in capsys.readouterr().out.splitlines())
