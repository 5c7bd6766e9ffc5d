# SPDX-License-Identifier: Apache-2.0
"""The command with everything real, on a few small frames of the built-in office."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp import run
from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.io.ply import read_ply
from ggwarp.io.trajectory import read_tum
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer

SMALL = ["--seq", "office", "--scale", "0.1", "--device", "cpu"]


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("run") / "first"
    assert run.main([*SMALL, "--frames", "0:5", "--out", str(out)]) == 0
    return out


def test_tracking_and_mapping_work(first):
    metrics = json.loads((first / "metrics.json").read_text())
    assert metrics["dataset"] == "synthetic" and metrics["frames"] == 5 and metrics["frames_lost"] == 0
    assert metrics["ate_rmse_cm"] < 1.0
    assert metrics["psnr"] > 18.0 and metrics["ssim"] > 0.5 and metrics["depth_l1_cm"] < 20.0
    assert 0.3 < metrics["miou"] <= 1.0


def test_the_map_knows_its_objects(first):
    gaussians = read_ply(first / "map.ply")
    objects = json.loads((first / "objects.json").read_text())["objects"]
    assert len(gaussians) == json.loads((first / "metrics.json").read_text())["gaussians"]
    assert gaussians.object_ids is not None and len(objects) > 2
    assert all(entry["class"] for entry in objects) and "floor" in {entry["class"] for entry in objects}
    for entry in objects:
        assert entry["count"] == np.count_nonzero(gaussians.object_ids == entry["id"])


def test_it_is_known_which_way_is_up(first):
    view = json.loads((first / "view.json").read_text())
    assert view["up_source"] == "surfaces" and view["up"] == pytest.approx([0.0, 0.0, 1.0], abs=0.05)


def test_the_file_alone_renders_the_same_picture(first):
    rows = read_ply(first / "map.ply")
    gaussians = GaussianMap(device="cpu", has_identity=False)
    gaussians.append(Gaussians(rows.means, rows.quats, rows.log_scales, rows.opacity_logits, rows.colours))
    renderer = Renderer(gaussians, SyntheticOffice(scale=0.1).camera)
    _, poses = read_tum(first / "trajectory.txt")
    for index in (0, 3):
        renderer.forward(renderer.pose_array(poses[index]))
        again = np.clip(renderer.plane(renderer.image)[:3].transpose(1, 2, 0), 0.0, 1.0)
        saved = cv2.imread(str(first / f"renders/frame{index:06d}_rgb.png"))[..., ::-1] / 255.0
        assert -10.0 * np.log10(np.mean((again - saved) ** 2)) > 40.0


def test_a_second_run_is_the_same_to_the_bit(first):
    second = first.with_name("second")
    assert run.main(["--config", str(first / "config.toml"), "--out", str(second)]) == 0
    for name in ("map.ply", "trajectory.txt", "objects.json", "renders/frame000003_rgb.png"):
        assert (second / name).read_bytes() == (first / name).read_bytes(), name


@pytest.mark.parametrize(
    "options",
    [
        ["--preset", "gs-icp"],
        ["--tracker", "ground-truth"],
        ["--fps", "2"],
        ["--fps", "uncapped", "--refine", "3"],
    ],
)
def test_other_ways_to_run(options, tmp_path):
    assert run.main([*SMALL, "--frames", "0:3", "--out", str(tmp_path), *options]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["frames"] == 3 and metrics["ate_rmse_cm"] < 1.0
    assert (metrics["frames_late"] > 0) == (metrics["late_ms_max"] > 0.0)
    assert metrics["latency_ms_p50"] > 0.0
    assert metrics["refine_iterations"] == (3 if "--refine" in options else 0)
    if "2" not in options:
        assert metrics["frames_late"] == 0
    if "gs-icp" in options:
        assert metrics["miou"] is None
        assert read_ply(tmp_path / "map.ply").object_ids is None
        assert not list((tmp_path / "renders").glob("*_objects.png"))


def test_ctrl_c_from_outside(tmp_path):
    command = [sys.executable, "-u", "-m", "ggwarp.run", *SMALL, "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        for line in process.stdout:
            if line.startswith("frames: "):
                process.send_signal(signal.SIGINT)
                break
        rest, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert f"saved in {tmp_path}" in rest and "Traceback" not in errors
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["frames"] > 0 and len(read_ply(tmp_path / "map.ply")) == metrics["gaussians"]
