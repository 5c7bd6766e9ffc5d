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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import CAMERA_FILES, Calibration, find_camera_file, read_calibration
from ggwarp.datasets.images import image_size
from ggwarp.datasets.poses import is_time, read_stamped
from ggwarp.datasets.sequence import Entry, FileSequence
from ggwarp.datasets.text import parse_float, read_lines
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.io.printable import printable, shown
from ggwarp.types import Float64

log = logging.getLogger(__name__)

DEPTH_TOLERANCE = 0.02
"""Largest time between a colour and its depth image, seconds."""
POSE_GAP = 0.11
"""Largest time between two true poses for one between them to be told from both, seconds: three frames."""
POSE_TOLERANCE = 0.005
"""Largest time between an image and a true pose taken at its time, seconds: half of what truth is apart."""

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


LISTS = ("rgb.txt", "depth.txt", "groundtruth.txt")


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a recording in this layout: any of its lists is there."""
    return any((path / name).exists() for name in LISTS)


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a recording; colour images without a depth image within 0.02 s are left out.

    An image's true pose is the one of its time, or else lies between those before and after it.

    Raises:
        DatasetError: a list is missing, no pair of images, an unknown camera, or malformed lists.
    """
    for name in LISTS[:2]:
        if not (path / name).exists():
            there = next(other for other in LISTS if (path / other).exists())
            raise DatasetError(
                f"{path}: {name} is missing; copy it again ({there} makes this a TUM recording, whose depth "
                f"has a scale of its own; without {' and '.join(LISTS)} it is read as a plain folder)"
            )
    rgb_stamps, rgb_files = _read_list(path / "rgb.txt")
    depth_stamps, depth_files = _read_list(path / "depth.txt")
    truth = path / "groundtruth.txt"
    pose_stamps, poses = read_stamped(truth) if truth.exists() else (np.zeros(0), [])
    true_poses = interpolated(rgb_stamps, pose_stamps, poses)
    depth_of = nearest(rgb_stamps, depth_stamps, tolerance=DEPTH_TOLERANCE)
    entries = [
        Entry(rgb, depth_files[d], float(stamp), T_wc, float(depth_stamps[d]))
        for rgb, stamp, d, T_wc in zip(rgb_files, rgb_stamps, depth_of, true_poses, strict=True)
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
    without = sum(entry.T_wc is None for entry in entries)
    if without and truth.exists():
        log.info("%s: %d of %d frames have no true pose in time", truth, without, len(entries))
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


def interpolated(stamps: Float64, others: Float64, poses: Sequence[Float64 | None]) -> list[Float64 | None]:
    """Return the pose at each of ``stamps`` [n] out of ``poses`` at the times ``others`` [m].

    The nearest counts where it is within :data:`POSE_TOLERANCE`; between two poses at most :data:`POSE_GAP`
    apart the camera moves and turns evenly; elsewhere there is no pose.
    """
    known = [i for i in np.argsort(others, kind="stable").tolist() if poses[i] is not None]
    times = others[known]

    def at(stamp: float) -> Float64 | None:
        after = int(np.searchsorted(times, stamp))
        beside = [i for i in (after - 1, after) if 0 <= i < len(times)]
        if not beside:
            return None
        ends = [poses[known[i]] for i in beside]
        nearer = int(np.argmin(np.abs(times[beside] - stamp)))
        if abs(times[beside[nearer]] - stamp) <= POSE_TOLERANCE:
            return ends[nearer]
        span = float(times[beside[-1]] - times[beside[0]])
        if 0.0 < span <= POSE_GAP:
            return _between(ends[0], ends[1], float(stamp - times[beside[0]]) / span)
        return None

    return [at(stamp) for stamp in stamps.tolist()]


def _between(first: Any, second: Any, share: float) -> Float64:
    T = first.copy()
    T[:3, 3] += share * (second[:3, 3] - first[:3, 3])
    T[:3, :3] = first[:3, :3] @ se3.so3_exp(share * se3.so3_log(first[:3, :3].T @ second[:3, :3]))
    return T


def _read_list(path: Path) -> tuple[Float64, list[Path]]:
    stamps, files = [], []
    for line, words in read_lines(path):
        if len(words) != 2:
            raise DatasetError(f"{path}:{line}: {shown(' '.join(words))}; expected a time and a file name")
        stamp = parse_float(words[0], path, line)
        if not is_time(stamp):
            raise DatasetError(f"{path}:{line}: {printable(words[0])} is not a time")
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


KIND = Kind("tum", "rgb.txt, depth.txt, groundtruth.txt", recognises, open_sequence)
