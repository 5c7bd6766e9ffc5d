# SPDX-License-Identifier: Apache-2.0
"""The TUM RGB-D benchmark, and one's own recordings in its layout.

``rgb.txt`` and ``depth.txt`` (time, file), ``groundtruth.txt`` (optional). The camera is told by
the sequence's name; a camera file in the folder goes before it.

Only colour is undistorted. The benchmark's depth was registered by the driver, whose target is
an *ideal* pinhole camera: in freiburg1_xyz, depth edges lie on the edges of the undistorted colour
picture (to 1-2 pixels at the top border, where the raw one is off by 5, which is just what the
lens model says there). Undistorting depth as well would bend it the wrong way.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import CAMERA_FILES, Calibration, find_camera_file, read_calibration
from ggwarp.datasets.images import image_size
from ggwarp.datasets.poses import read_stamped
from ggwarp.datasets.sequence import Entry, FileSequence
from ggwarp.datasets.text import parse_float, read_lines
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float64

log = logging.getLogger(__name__)

DEPTH_TOLERANCE = 0.02
"""Largest time between a colour and its depth image, seconds."""
POSE_TOLERANCE = 0.08
"""Largest time between a colour image and its true pose, seconds."""

_DEPTH_SCALE = 5000.0
_CAMERAS = {
    "freiburg1": Calibration(
        Camera(640, 480, 517.306408, 516.469215, 318.643040, 255.313989),
        _DEPTH_SCALE,
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "freiburg2": Calibration(
        Camera(640, 480, 520.908620, 521.007327, 325.141442, 249.701764),
        _DEPTH_SCALE,
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "freiburg3": Calibration(Camera(640, 480, 535.4, 539.2, 320.1, 247.6), _DEPTH_SCALE),
}
"""The benchmark's own calibrations; freiburg3 is published undistorted."""


def full_name(name: str) -> str | None:
    """Return the archive's name of a sequence named in short, None when it is not TUM's.

    ``fr1/xyz``, ``fr1_xyz`` and ``freiburg1_xyz`` are ``rgbd_dataset_freiburg1_xyz``.
    """
    match = re.fullmatch(r"(?:rgbd_dataset_)?(?:freiburg|fr)([123])[_/](\w+)", name)
    return f"rgbd_dataset_freiburg{match[1]}_{match[2]}" if match else None


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a recording in this layout."""
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a recording; colour images without a depth image within 0.02 s are left out.

    Raises:
        DatasetError: no pair of images, an unknown camera, or malformed lists.
    """
    rgb_stamps, rgb_files = _read_list(path / "rgb.txt")
    depth_stamps, depth_files = _read_list(path / "depth.txt")
    truth = path / "groundtruth.txt"
    pose_stamps, poses = read_stamped(truth) if truth.is_file() else (np.zeros(0), [])
    depth_of = nearest(rgb_stamps, depth_stamps, tolerance=DEPTH_TOLERANCE)
    pose_of = nearest(rgb_stamps, pose_stamps, tolerance=POSE_TOLERANCE)
    entries = [
        Entry(rgb, depth_files[d], float(stamp), poses[p] if p >= 0 else None, float(depth_stamps[d]))
        for rgb, stamp, d, p in zip(rgb_files, rgb_stamps, depth_of, pose_of, strict=True)
        if d >= 0
    ]
    if not entries:
        raise DatasetError(
            f"{path}: no colour and depth image within {DEPTH_TOLERANCE} s of each other "
            f"(rgb.txt lists {len(rgb_files)}, depth.txt {len(depth_files)})"
        )
    if len(entries) < len(rgb_files):
        unpaired = len(rgb_files) - len(entries)
        log.info("%s: %d of %d colour images have no depth in time", path, unpaired, len(rgb_files))
    return FileSequence(path, "tum", entries, _calibration(path, entries), masks=masks)


def nearest(stamps: Float64, others: Float64, *, tolerance: float) -> np.ndarray:
    """Return, for each of ``stamps`` [n], the index of the nearest of ``others`` [m]; -1 = none in reach."""
    if not len(others):
        return np.full(len(stamps), -1)
    order = np.argsort(others, kind="stable")
    ranked = others[order]
    after = np.searchsorted(ranked, stamps).clip(1, max(len(others) - 1, 1))
    pair = np.stack([after - 1, after.clip(max=len(others) - 1)])
    distance = np.abs(ranked[pair] - stamps)
    closer = np.argmin(distance, axis=0)
    columns = np.arange(len(stamps))
    return np.where(distance[closer, columns] <= tolerance, order[pair[closer, columns]], -1)


def _read_list(path: Path) -> tuple[Float64, list[Path]]:
    stamps, files = [], []
    for line, words in read_lines(path):
        if len(words) != 2:
            raise DatasetError(f"{path}:{line}: {' '.join(words)!r}; expected a time and a file name")
        stamp = parse_float(words[0], path, line)
        if not np.isfinite(stamp):
            raise DatasetError(f"{path}:{line}: {words[0]} is not a time")
        stamps.append(stamp)
        files.append(path.parent / words[1])
    return np.array(stamps), files


def _calibration(path: Path, entries: list[Entry]) -> Calibration:
    if any((path / name).is_file() for name in CAMERA_FILES):
        size = image_size([entry.rgb for entry in entries[:3]])
        return read_calibration(find_camera_file([path]), depth_scale=_DEPTH_SCALE, size=size)
    match = re.search(r"(?:freiburg|fr)([123])(?!\d)", path.resolve().name)
    if match is None:
        raise DatasetError(
            f"{path}: which camera? Its name has no freiburg1, 2 or 3; write a calibration.txt there: "
            "fx fy cx cy [k1 k2 p1 p2 k3]"
        )
    return _CAMERAS[f"freiburg{match[1]}"]


KIND = Kind("tum", "rgb.txt and depth.txt", recognises, open_sequence)
