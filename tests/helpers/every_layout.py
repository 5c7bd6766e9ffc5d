# SPDX-License-Identifier: Apache-2.0
"""Every layout that is read from a disk, each a recording of three frames of ``recorded_scene``."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from bag_recordings import mcap, realsense, ros1, ros2
from distributed_data_sets import LAYOUTS, bonn, sens
from phone_recordings import r3d, write
from recorded_scene import COLOUR, jpeg, look, millimetres, png, pose, quaternion

FRAMES = 3
_FILES = ("scan.r3d", "scan.sens", "scan.bag", "scan.mcap", "scan", "rgbd_bonn_static")
WITHOUT_TRUTH = ("open3d",)
"""Of :data:`KINDS`, those that say nothing of where the camera was."""


def plain(path: Path, kind: str) -> None:
    for i in range(FRAMES):
        rgb, depth = look(COLOUR, pose(i))
        folders = ("results", "results") if kind == "replica" else ("color", "depth")
        names = (
            (f"frame{i:06d}.jpg", f"depth{i:06d}.png") if kind == "replica" else (f"{i}.png", f"{i}.{kind}")
        )
        for folder in folders:
            (path / folder).mkdir(exist_ok=True, parents=True)
        assert cv2.imwrite(str(path / folders[0] / names[0]), rgb[..., ::-1])
        place = path / folders[1] / names[1]
        if kind == "npy":
            np.save(place, depth)
        else:
            assert cv2.imwrite(str(place), millimetres(depth))
        (path / "object_mask").mkdir(exist_ok=True)
        stem = f"frame{i:06d}" if kind == "replica" else str(i)
        assert cv2.imwrite(str(path / f"object_mask/{stem}.png"), (depth > 2).astype(np.uint8))
    names = {
        "w": 80,
        "h": 60,
        "fx": COLOUR.fx,
        "fy": COLOUR.fy,
        "cx": COLOUR.cx,
        "cy": COLOUR.cy,
        "scale": 1000,
    }
    text = str(names).replace("'", '"')
    (path / ("cam_params.json" if kind == "replica" else "camera.json")).write_text(text)
    rows = (" ".join(map(str, pose(i).ravel())) for i in range(FRAMES))
    (path / "traj.txt").write_text("\n".join(rows))


def tum(path: Path) -> None:
    plain(path, "png")
    for name, folder in (("rgb", "color"), ("depth", "depth")):
        (path / f"{name}.txt").write_text("".join(f"{i / 30:.6f} {folder}/{i}.png\n" for i in range(FRAMES)))
    rows = (map(str, [f"{i / 30:.6f}", *pose(i)[:3, 3], *quaternion(pose(i))]) for i in range(FRAMES))
    (path / "groundtruth.txt").write_text("".join(" ".join(row) + "\n" for row in rows))


def open3d(path: Path) -> None:
    """Write what Open3D's recorder of a RealSense does; its matrix is by columns."""
    for i in range(FRAMES):
        rgb, depth = look(COLOUR, pose(i))
        write(path / f"color/{i:06d}.jpg", jpeg(rgb))
        write(path / f"depth/{i:06d}.png", png(millimetres(depth)))
    camera = {"width": 80, "height": 60, "intrinsic_matrix": COLOUR.matrix.T.ravel().tolist()}
    write(path / "camera_intrinsic.json", json.dumps(camera))


KINDS: dict[str, Callable[[Path], object]] = {
    **LAYOUTS,
    "r3d": lambda path: r3d(path / "scan.r3d"),
    "sens": lambda path: sens(path / "scan.sens"),
    "ros1": lambda path: ros1(path / "scan.bag", registered=False, compressed=True),
    "realsense": lambda path: realsense(path / "scan.bag"),
    "ros2": lambda path: ros2(path / "scan", registered=True, compressed=False),
    "mcap": lambda path: mcap(path / "scan.mcap", registered=False, compressed=False),
    "bonn": lambda path: bonn(path / "rgbd_bonn_static"),
    "open3d": open3d,
    "replica": lambda path: plain(path, "replica"),
    "png": lambda path: plain(path, "png"),
    "tiff": lambda path: plain(path, "tiff"),
    "npy": lambda path: plain(path, "npy"),
    "tum": tum,
}
"""Name -> what writes such a recording into a folder."""


def place(folder: Path) -> Path:
    """Return what ``--seq`` is to name of what one of :data:`KINDS` wrote into ``folder``."""
    return next((folder / name for name in _FILES if (folder / name).exists()), folder)
