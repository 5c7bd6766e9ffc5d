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

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import CAMERA_FILES, Calibration, find_camera_file, read_calibration
from ggwarp.datasets.images import image_size
from ggwarp.datasets.pairing import TIME_TOLERANCE as DEPTH_TOLERANCE
from ggwarp.datasets.pairing import pair_times
from ggwarp.datasets.poses import in_seconds, read_stamped
from ggwarp.datasets.sequence import Entry, FileSequence
from ggwarp.datasets.source import Source, unread_entries
from ggwarp.datasets.text import parse_float, read_lines
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.io.printable import shown
from ggwarp.types import Float64

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
    "bonn": Calibration(
        Camera(640, 480, 542.822841, 542.576870, 315.593520, 237.756098),
        _DEPTH_SCALE,
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    ),
}
"""The benchmark's own calibrations; freiburg3 is published undistorted. And that of Bonn's dynamic scenes."""

_BONN_AXES = np.array(
    [[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_BONN_MARKERS = se3.orthonormalised(
    np.array(
        [
            [1.0157, 0.1828, -0.2389, 0.0113],
            [0.0009, -0.8431, -0.6413, -0.0098],
            [-0.3009, 0.6147, -0.8085, 0.0111],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
)
"""Bonn's truth is of a frame of markers with other axes; by these two, as published, it is the camera's. The
second is published with a rotation that is none to a few per cent: the nearest one is taken."""


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

    Lists may be in any order and in s, ms, us or ns; no depth image is used twice.
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
    rgb, depth = _read_list(path / "rgb.txt"), _read_list(path / "depth.txt")
    truth = path / "groundtruth.txt"
    pose_stamps, poses = read_stamped(truth) if truth.exists() else (np.zeros(0), [])
    if _camera_name(path) == "bonn":
        poses = [None if P is None else _BONN_AXES @ P @ _BONN_AXES @ _BONN_MARKERS for P in poses]
    true_poses = interpolated(rgb.stamps, pose_stamps, poses)
    pairing = pair_times(rgb.stamps, depth.stamps, tolerance=DEPTH_TOLERANCE)
    entries = [
        Entry(file, depth.files[d], float(stamp), T_wc, float(depth.stamps[d]))
        for file, stamp, d, T_wc in zip(rgb.files, rgb.stamps, pairing.partners, true_poses, strict=True)
        if d >= 0
    ]
    if not entries:
        raise DatasetError(
            f"{path}: no colour and depth image within {DEPTH_TOLERANCE} s of each other (rgb.txt lists "
            f"{len(rgb.files)}{_span(rgb.stamps)}, depth.txt {len(depth.files)}{_span(depth.stamps)})"
        )
    known = sum(entry.T_wc is not None for entry in entries)
    notes = [*rgb.notes, *depth.notes]
    if truth.exists() and not known:
        notes.append(
            f"groundtruth.txt has {len(poses)} poses{_span(pose_stamps)}, but none within {POSE_GAP:g} s of "
            f"an image{_span(rgb.stamps)}: nothing is measured; is it of another clock?"
        )
    read = {path / name for name in (*LISTS, *CAMERA_FILES)} | {
        path / file.relative_to(path).parts[0]
        for file in (*rgb.files[:1], *depth.files[:1])
        if file.is_relative_to(path)
    }
    source = Source(
        layout="TUM RGB-D's layout, rgb.txt and depth.txt",
        pairing=pairing.summary("colour images", "depth images"),
        truth=f"groundtruth.txt, poses of {known} of {len(entries)} frames" if truth.exists() else "",
        notes=tuple(notes),
        unread=unread_entries(path, read),
    )
    return FileSequence(path, "tum", entries, _calibration(path, entries), masks=masks, source=source)


def _span(stamps: Float64) -> str:
    return f" ({stamps.min():.2f} to {stamps.max():.2f} s)" if len(stamps) else ""


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


class _Listed(NamedTuple):
    """What a list names: files and their times, in order of time; and what is odd about it."""

    stamps: Float64
    files: list[Path]
    notes: list[str]


def _read_list(path: Path) -> _Listed:
    times, files, lines = [], [], []
    for line, words in read_lines(path):
        if len(words) != 2:
            raise DatasetError(f"{path}:{line}: {shown(' '.join(words))}; expected a time and a file name")
        times.append(parse_float(words[0], path, line))
        files.append(path.parent / words[1].replace("\\", "/"))  # a list written on Windows
        lines.append(line)
    stamps, unit = in_seconds(times, path, lines)
    notes = [] if unit == "s" else [f"{path.name}: its times are taken for {unit}, by their size"]
    order = np.argsort(stamps, kind="stable").tolist()
    if order != list(range(len(stamps))):
        notes.append(f"{path.name}: is not in order of time, and is sorted")
    seen: set[Path] = set()
    kept = [i for i in order if not (files[i] in seen or seen.add(files[i]))]
    if len(kept) < len(order):
        notes.append(f"{path.name}: names {len(order) - len(kept)} files again; they are used once")
    return _Listed(stamps[kept], [files[i] for i in kept], notes)


def _calibration(path: Path, entries: list[Entry]) -> Calibration:
    if any((path / name).is_file() for name in CAMERA_FILES):
        size = image_size([entry.rgb for entry in entries[:3] if isinstance(entry.rgb, Path)])
        return read_calibration(find_camera_file([path]), depth_scale=_DEPTH_SCALE, size=size)
    name = _camera_name(path)
    if name is None:
        raise DatasetError(
            f"{path}: which camera? Its name has no freiburg1, 2 or 3; write a calibration.txt there: "
            "fx fy cx cy [k1 k2 p1 p2 k3]"
        )
    origin = f"the benchmark's {name}"
    return replace(_CAMERAS[name], origin=origin, scale_origin=origin)


def _camera_name(path: Path) -> str | None:
    """Return the benchmark's name of the camera that the folder's name tells; None: it tells none."""
    folder = path.resolve().name
    match = re.search(r"(?:freiburg|fr)([123])(?!\d)", folder)
    if match is not None:
        return f"freiburg{match[1]}"
    return "bonn" if folder.startswith("rgbd_bonn") else None


KIND = Kind("tum", "rgb.txt, depth.txt, groundtruth.txt", recognises, open_sequence)
