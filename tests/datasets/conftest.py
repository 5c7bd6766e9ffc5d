# SPDX-License-Identifier: Apache-2.0
"""Small recordings of each kind, made in a temporary folder."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ggwarp.geometry import se3

WIDTH, HEIGHT = 24, 16
CAMERA = {"w": WIDTH, "h": HEIGHT, "fx": 20.0, "fy": 20.0, "cx": 11.5, "cy": 7.5, "scale": 1000.0}


def colour(i: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return image i, [h, w, 3] BGR: red counts columns, green rows, blue frames."""
    v, u = np.mgrid[:height, :width]
    return np.stack([np.full_like(u, i), v * 5, u * 5], axis=-1).astype(np.uint8)


def depth(i: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return depth image i, raw: 1000 + i, with a hole in the corner."""
    image = np.full((height, width), 1000 + i, np.uint16)
    image[0, 0] = 0
    return image


def pose(i: int) -> np.ndarray:
    return se3.se3_exp([0.1 * i, 0.0, 0.0, 0.0, 0.05 * i, 0.0])


def save(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


def matrix_row(T: np.ndarray) -> str:
    return " ".join(f"{x:.12g}" for x in T.ravel())


@pytest.fixture
def sample() -> SimpleNamespace:
    """What the recordings are made of."""
    return SimpleNamespace(
        width=WIDTH, height=HEIGHT, colour=colour, depth=depth, pose=pose, save=save, matrix_row=matrix_row
    )


@pytest.fixture
def make_replica(tmp_path: Path) -> Callable[..., Path]:
    """make_replica(n, spelling="results") -> the scene's folder, in a data root ``tmp_path``."""

    def make(n: int = 4, *, spelling: str = "results", name: str = "scene", poses: bool = True) -> Path:
        scene = tmp_path / "Replica" / name
        rgb, dep = ("results", "results") if spelling == "results" else ("images", "depth_images")
        for i in range(n):
            save(scene / rgb / f"frame{i:06d}.png", colour(i))
            save(scene / dep / f"depth{i:06d}.png", depth(i))
        scene.mkdir(parents=True, exist_ok=True)
        (scene.parent / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
        if poses:
            (scene / "traj.txt").write_text("\n".join(matrix_row(pose(i)) for i in range(n)) + "\n")
        return scene

    return make


@pytest.fixture
def make_tum(tmp_path: Path) -> Callable[..., Path]:
    """make_tum(rgb_times, depth_times, pose_times) -> the recording's folder, camera in calibration.txt."""

    def make(
        rgb_times: list[float],
        depth_times: list[float],
        pose_times: list[float] | None = None,
        *,
        name: str = "own",
        calibration: str | None = "20 20 11.5 7.5",
    ) -> Path:
        folder = tmp_path / "TUM" / name
        folder.mkdir(parents=True)
        for kind, times, image in (("rgb", rgb_times, colour), ("depth", depth_times, depth)):
            for i, t in enumerate(times):
                save(folder / kind / f"{t:.6f}.png", image(i))
            lines = [f"{t:.6f} {kind}/{t:.6f}.png" for t in times]
            (folder / f"{kind}.txt").write_text("\n".join(["# timestamp filename", *lines]) + "\n")
        if pose_times is not None:
            rows = [f"{t:.4f} {i} 0 0 0 0 0 1" for i, t in enumerate(pose_times)]
            (folder / "groundtruth.txt").write_text("\n".join(["# ground truth", *rows]) + "\n")
        if calibration is not None:
            (folder / "calibration.txt").write_text(calibration)
        return folder

    return make


@pytest.fixture
def make_folder(tmp_path: Path) -> Callable[..., Path]:
    """make_folder(n, colour_folder="color") -> a plain folder with camera.json."""

    def make(
        n: int = 3, *, colour_folder: str = "color", with_depth: bool = True, camera: bool = True
    ) -> Path:
        folder = tmp_path / "own"
        for i in range(n):
            save(folder / colour_folder / f"{i}.png", colour(i))
            if with_depth:
                save(folder / "depth" / f"{i}.png", depth(i))
        folder.mkdir(exist_ok=True)
        if camera:
            (folder / "camera.json").write_text(json.dumps(CAMERA))
        return folder

    return make
