# SPDX-License-Identifier: Apache-2.0
"""ARKitScenes, as Apple distributes its raw data.

``lowres_wide/`` (colour), ``lowres_depth/`` (millimetres), ``confidence/`` (0 to 2) and
``lowres_wide_intrinsics/*.pincam`` (width height fx fy cx cy), all named ``<video>_<seconds>``, and
``lowres_wide.traj``: seconds, a rotation as axis times angle, a position; world-to-camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.poses import is_time, rigid
from ggwarp.datasets.readers.tum import interpolated
from ggwarp.datasets.rig import typical_camera
from ggwarp.datasets.sequence import Entry, FileSequence, image_files
from ggwarp.datasets.source import recorder_source
from ggwarp.datasets.text import read_numbers
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float64


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a scene in this layout."""
    return (path / "lowres_wide").is_dir()


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a scene.

    Raises:
        DatasetError: no image has its intrinsics, or a file is malformed.
    """
    colour, stamps, cameras = [], [], []
    for rgb in image_files(path / "lowres_wide"):
        file = _intrinsics(path / "lowres_wide_intrinsics", rgb.stem)
        if file is not None:
            colour.append(rgb)
            stamps.append(_seconds(rgb))
            cameras.append(_camera(file))
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (lowres_wide/ with lowres_wide_intrinsics/)")
    truth = path / "lowres_wide.traj"
    times, poses = _trajectory(truth) if truth.is_file() else (np.zeros(0), [])
    entries = []
    for rgb, stamp, camera, T_wc in zip(
        colour, stamps, cameras, interpolated(np.array(stamps), times, poses), strict=True
    ):
        depth, confidence = path / "lowres_depth" / rgb.name, path / "confidence" / rgb.name
        metric = depth.with_suffix(".png")
        sure = confidence.with_suffix(".png")
        entries.append(
            Entry(
                rgb,
                metric if metric.is_file() else None,
                stamp,
                T_wc,
                camera=camera,
                confidence=sure if sure.is_file() else None,
            )
        )
    source = recorder_source(
        "ARKitScenes, lowres_wide/ and lowres_depth/",
        entries,
        camera="lowres_wide_intrinsics/, frame by frame",
        depth_unit="millimetres, as published",
        truth="lowres_wide.traj, by ARKit",
    )
    calibration = Calibration(typical_camera(cameras), 1000.0)
    return FileSequence(path, "arkitscenes", entries, calibration, masks=masks, source=source)


def _seconds(path: Path) -> float:
    try:
        stamp = float(path.stem.rsplit("_", 1)[-1])
    except ValueError:
        stamp = float("nan")
    if not is_time(stamp):
        raise DatasetError(f"{path}: its name has no time; expected such as 41069021_305.377.png")
    return stamp


def _intrinsics(folder: Path, stem: str) -> Path | None:
    """Return a frame's file; its time may be rounded to the millisecond before or after."""
    video, _, seconds = stem.rpartition("_")
    try:
        near = [seconds, *(f"{float(seconds) + step:.3f}" for step in (-0.001, 0.001))]
    except ValueError:
        near = [seconds]
    files = [folder / f"{video}_{time}.pincam" for time in near]
    return next((file for file in files if file.is_file()), None)


def _camera(path: Path) -> Camera:
    values = [value for _, row in read_numbers(path) for value in row]
    if len(values) != 6 or not np.isfinite(values).all() or min(values[:4]) <= 0.0:
        raise DatasetError(f"{path}: expected width height fx fy cx cy, found {len(values)} numbers")
    return Camera(int(values[0]), int(values[1]), *values[2:])


def _trajectory(path: Path) -> tuple[Float64, list[Float64 | None]]:
    times, poses = [], []
    for line, values in read_numbers(path):
        if len(values) != 7 or not is_time(values[0]):
            raise DatasetError(f"{path}:{line}: expected a time, axis times angle, and a position")
        T_cw = np.eye(4)
        T_cw[:3, :3] = se3.so3_exp(values[1:4]) if np.isfinite(values).all() else np.nan
        T_cw[:3, 3] = values[4:]
        good = rigid(T_cw)
        times.append(values[0])
        poses.append(None if good is None else se3.inverse(good))
    return np.array(times), poses


KIND = Kind("arkitscenes", "ARKitScenes: lowres_wide/", recognises, open_sequence)
