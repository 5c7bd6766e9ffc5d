# SPDX-License-Identifier: Apache-2.0
"""The command's manners, with a stand-in for the SLAM system: what it says, leaves and returns."""

from __future__ import annotations

import contextlib
import csv
import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ggwarp import config, run, session
from ggwarp.config.options import option_table
from ggwarp.datasets import reader
from ggwarp.geometry.camera import Camera
from ggwarp.io.ply import read_ply
from ggwarp.io.trajectory import read_tum
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import inventory
from ggwarp.objects.linear_classifier import LinearClassifier
from ggwarp.results import run_folder
from ggwarp.results.saved_run import load_run
from ggwarp.types import Rendered, StepReport, Verdict

WIDTH, HEIGHT, FRAMES = 64, 48, 6


@pytest.fixture
def scene(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Six frames in the Replica layout, with poses and masks."""
    folder = tmp_path / "data" / "Replica" / "room9"
    (folder / "results").mkdir(parents=True)
    (folder / "object_mask").mkdir()
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "scale": 1000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    rows = []
    for i in range(FRAMES):
        rgb = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
        cv2.imwrite(str(folder / f"results/frame{i:06d}.jpg"), rgb)
        cv2.imwrite(str(folder / f"results/depth{i:06d}.png"), np.full((HEIGHT, WIDTH), 2000, np.uint16))
        cv2.imwrite(str(folder / f"object_mask/frame{i:06d}.png"), np.full((HEIGHT, WIDTH), 4, np.uint8))
        T_wc = np.eye(4)
        T_wc[0, 3] = 0.1 * i
        rows.append(" ".join(map(str, T_wc.ravel())))
    (folder / "traj.txt").write_text("\n".join(rows) + "\n")
    return folder


class FakeSlam:
    """Knows every pose, renders grey, and does on each frame what the test asks for."""

    on_track = staticmethod(lambda index: None)
    on_map = staticmethod(lambda index: None)
    on_refine = staticmethod(lambda done: None)
    sequential_only = False
    can_refine = True

    def __init__(self, config, camera, sensor_camera, *, device, scheduler=None):
        self.camera, self.device, self.scheduler = camera, device, scheduler
        self.refined = 0
        self.keyframe_indices, self.voting_indices = [0, 1], [3]
        self.counts = {"tracking_keyframes": 1, "mapping_keyframes": 1, "frames_lost": 0}

    def track_frame(self, frame):
        self.on_track(frame.index)
        return SimpleNamespace(frame=frame)

    def map_frame(self, tracked, waiting=None):
        self.on_map(tracked.frame.index)
        return self._report(tracked.frame, 3)

    def leave_unmapped(self, tracked):
        return self._report(tracked.frame, 0)

    def skip_frame(self):
        pass

    def fitted_poses(self):
        return {}

    def in_two_threads(self):
        return contextlib.nullcontext()

    def refine(self):
        self.refined += 1
        self.on_refine(self.refined)

    def _report(self, frame, iterations):
        T_wc = np.eye(4) if frame.T_wc is None else frame.T_wc
        return StepReport(
            frame.index, frame.timestamp, T_wc, Verdict.CONVERGED, "", 1.0, 0.0, "", 1.0, 2.0, iterations, 7,
            loss=0.1, latency_ms=1.0,
        )  # fmt: skip

    def render(self, T_wc):
        shape = (self.camera.height, self.camera.width)
        plane = np.full(shape, 2.0, np.float32)
        ids = np.full(shape, 4, np.int32)
        identity = np.zeros((*shape, 16), np.float32)
        grey, opaque = np.full((*shape, 3), 0.5, np.float32), np.ones(shape, np.float32)
        return Rendered(grey, plane, plane, opaque, identity, ids)

    def map_arrays(self):
        ids = np.array([0, 0, 0, 4, 4, 4, 4], np.int32)
        values = np.arange(21, dtype=np.float32).reshape(7, 3)
        identities = np.random.default_rng(0).normal(size=(7, 16)).astype(np.float32)
        quats = np.tile(np.float32([1, 0, 0, 0]), (7, 1))
        return Gaussians(values, quats, values, values[:, 0], values, ids, identities)

    def objects(self, names):
        arrays = self.map_arrays()
        return inventory(arrays.means, arrays.colours, arrays.object_ids, names=names)

    def linear_classifier(self):
        return LinearClassifier(np.ones((2, 16), np.float32), np.zeros(2, np.float32), np.array([0, 4]))


@pytest.fixture
def fake(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GGWARP_DATA", raising=False)
    monkeypatch.setattr(session, "Slam", FakeSlam)
    monkeypatch.setattr(session, "load_kernels", lambda device, display: None)
    return FakeSlam


def _only_line(capsys) -> str:
    """Return the one line of standard error; a traceback would be many."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def test_a_run_leaves_its_folder(scene, fake, tmp_path, capsys):
    assert run.main(["--seq", "room9", "--scale", "0.5", "--device", "cpu", "--save-renders", "4"]) == 0
    out = capsys.readouterr().out
    assert "6 frames on cpu at 32x24 (--scale 0.5 of 64x48)" in out and "psnr " in out
    folder = tmp_path / "runs" / "latest"
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    pictures = {
        f"renders/frame{i:06d}_{w}.png" for i in (0, 4) for w in ("rgb", "depth", "objects", "features")
    }
    assert files == pictures | set(run_folder.OUTPUTS)
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
    monkeypatch.setattr(session, "LiveScheduler", lambda fps, frames: made.append(fps) or SimpleNamespace())
    monkeypatch.setattr(session, "UncappedScheduler", lambda: made.append("uncapped") or SimpleNamespace())
    for fps in ("30", "uncapped"):
        assert run.main(["--seq", "room9", "--device", "cpu", "--fps", fps, "--out", "o"]) == 0
        assert run.main(["--config", "o/config.toml", "--out", "again"]) == 0
    assert made == [30.0, 30.0, "uncapped", "uncapped"]


def test_refinement_is_counted(scene, fake):
    assert run.main(["--seq", "room9", "--device", "cpu", "--refine", "5", "--out", "o"]) == 0
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["refine_iterations"] == 5 and metrics["refine_s"] > 0.0
    assert metrics["mapping_iterations"] == 3 * FRAMES, "refinement is not part of the frames' mapping"


def test_ctrl_c_ends_the_refinement_only(scene, fake, monkeypatch, capsys):
    def interrupt(done):
        if done == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(fake, "on_refine", staticmethod(interrupt))
    assert run.main(["--seq", "room9", "--device", "cpu", "--refine", "50", "--out", "o"]) == 0
    assert "refinement ended after 3 of 50 iterations" in capsys.readouterr().out
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["refine_iterations"] == 3 and metrics["psnr"] is not None


def test_a_tracker_that_works_in_turn(scene, fake, monkeypatch, capsys):
    monkeypatch.setattr(fake, "sequential_only", True)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o", "--pipelined", "on"]) == 2
    assert "--pipelined on: here tracking looks at the Gaussians" in capsys.readouterr().err.splitlines()[-1]


def test_bad_frames_are_skipped_and_counted(scene, fake, capsys):
    (scene / "results" / "frame000002.jpg").write_bytes(b"not a picture")
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    assert "frame 2 skipped: " in _only_line(capsys)
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
    monkeypatch.setattr("ggwarp.session._KEPT_BYTES", 0)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    assert json.loads(Path("o/metrics.json").read_text())["heldout_frames"] == FRAMES - 2


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
        monkeypatch.setattr(run_folder, "write_ply", asking(run_folder.write_ply))
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
    assert _only_line(capsys) == "ggwarp: interrupted; nothing was saved"
    assert {p.name for p in Path().iterdir()} == {"data"}


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
    line = _only_line(capsys)
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
    assert "give --intrinsics FX FY CX CY" in _only_line(capsys)


def test_an_empty_sequence(scene, fake, capsys):
    for path in (scene / "results").iterdir():
        path.unlink()
    assert run.main(["--seq", "room9", "--device", "cpu"]) == 2
    assert "empty" in _only_line(capsys)


def test_no_space_left(scene, fake, monkeypatch, capsys):
    def full(path, *arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(run_folder, "write_ply", full)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 1
    reason = f"saving the map failed: {Path('o/map.ply')}: No space left on device"
    assert _only_line(capsys) == f"ggwarp: {reason}"
    assert json.loads(Path("o/metrics.json").read_text())["failures"] == [reason]
    assert len(read_tum(Path("o/trajectory.txt"))[0]) == FRAMES and Path("o/objects.json").is_file()


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


def test_an_earlier_run_outlives_one_that_cannot_be_saved(scene, fake, monkeypatch, capsys):
    before = _run_once(capsys)

    def full(path, *arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(run_folder, "write_ply", full)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 1
    assert before == {p.name: p.read_bytes() for p in Path("o").iterdir() if p.is_file()}
    out, errors = capsys.readouterr()
    assert out.splitlines()[-1] == "1 part failed; the rest is in o-incomplete"
    assert "warning: the earlier run in o stays, as this one is not whole" in errors
    assert len(read_tum(Path("o-incomplete/trajectory.txt"))[0]) == FRAMES


def test_a_folder_of_other_files_is_left_alone(scene, fake, capsys):
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "data"]) == 2
    assert _only_line(capsys).startswith("ggwarp: data: holds other files and no run")
    assert [p.name for p in Path("data").iterdir()] == ["Replica"]


@pytest.mark.parametrize("part", ["evaluation", "saving renders"])
def test_what_follows_the_saving_may_fail_alone(scene, fake, monkeypatch, capsys, part):
    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "here")

    name = {"evaluation": "compare", "saving renders": "RenderWriter"}[part]
    monkeypatch.setattr(session, name, full)
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
    assert "Input/output error" in _only_line(capsys)


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
