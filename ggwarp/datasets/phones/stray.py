# SPDX-License-Identifier: Apache-2.0
"""Recordings of the Stray Scanner app (iPhones and iPads with LiDAR).

``rgb.mp4``, ``depth/%06d.png`` (millimetres, smaller than the colour), ``confidence/%06d.png`` (0 to 2),
``camera_matrix.csv`` (3x3, of the video's size) and ``odometry.csv``: time, frame, position, quaternion
x y z w, camera-to-world with the axes of OpenCV; newer versions add fx, fy, cx, cy of each frame.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import DEPTH_SUFFIXES
from ggwarp.datasets.poses import is_time, pose_from_quaternion
from ggwarp.datasets.readers.video import VideoFile
from ggwarp.datasets.rig import typical_camera
from ggwarp.datasets.sequence import Entry, FileSequence, Picture, image_files
from ggwarp.datasets.source import recorder_source, unread_entries, whole_numbers
from ggwarp.datasets.text import parse_float, read_lines, read_numbers
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float64

_MILLIMETRES = 1000.0
_FILES = ("rgb.mp4", "camera_matrix.csv", "odometry.csv")


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a recording in this layout."""
    return (
        (path / "rgb.mp4").is_file()
        and (path / "depth").is_dir()
        and any((path / name).is_file() for name in _FILES[1:])
    )


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a recording.

    Raises:
        DatasetError: a file is missing, or malformed.
    """
    for name in _FILES:
        if not (path / name).is_file():
            raise DatasetError(f"{path / name}: is missing; copy the whole folder of the recording again")
    video = VideoFile(path / "rgb.mp4", turned=False)
    rows = _odometry(path / "odometry.csv", *video.size)
    depth = whole_numbers(image_files(path / "depth", suffixes=DEPTH_SUFFIXES))
    if not depth:
        raise DatasetError(f"{path}: the sequence is empty (no images in depth/)")
    cameras = [camera for _, _, camera in rows.values() if camera]
    camera = typical_camera(cameras) if cameras else _camera(path / "camera_matrix.csv", *video.size)
    entries = []
    for number, file in sorted((n, f) for n, f in depth.items() if n in rows):
        stamp, T_wc, own = rows[number]
        confidence = path / "confidence" / file.name
        rgb = Picture(video.path / f"{number:06d}", partial(video.read, number))
        present = confidence if confidence.is_file() else None
        entries.append(Entry(rgb, file, stamp, T_wc, camera=own, confidence=present))
    if not entries:
        raise DatasetError(f"{path}: no image in depth/ has a line of odometry.csv with its number")
    source = recorder_source(
        "Stray Scanner, rgb.mp4 and depth/",
        entries,
        camera="odometry.csv, frame by frame" if cameras else "camera_matrix.csv",
        depth_unit="millimetres, as the app writes",
        truth="odometry.csv, by ARKit",
        unread=unread_entries(path, [path / name for name in (*_FILES, "depth", "confidence", "imu.csv")]),
    )
    calibration = Calibration(camera, _MILLIMETRES)
    return FileSequence(path, "stray", entries, calibration, masks=masks, source=source)


def _camera(path: Path, width: int, height: int) -> Camera:
    rows = [values for _, values in read_numbers(path)]
    if [len(row) for row in rows] != [3, 3, 3]:
        raise DatasetError(f"{path}: expected a 3x3 matrix, found {len(rows)} lines")
    return Camera(width, height, rows[0][0], rows[1][1], rows[0][2], rows[1][2])


def _odometry(path: Path, width: int, height: int) -> dict[int, tuple[float, Float64 | None, Camera | None]]:
    """Return frame number -> time in seconds, pose and, where it is told, camera."""
    found: dict[int, tuple[float, Float64 | None, Camera | None]] = {}
    columns: list[str] = []
    for line, words in read_lines(path):
        if not columns:
            columns = [word.lower() for word in words]
            if columns[:2] != ["timestamp", "frame"]:
                raise DatasetError(f"{path}:{line}: expected the names of columns, timestamp, frame, x, ...")
            continue
        if len(words) != len(columns):
            raise DatasetError(f"{path}:{line}: {len(words)} values for {len(columns)} columns")
        row = {name: parse_float(word, path, line) for name, word in zip(columns, words, strict=True)}
        frame = row["frame"]
        if not is_time(row["timestamp"]) or not 0 <= frame < 1e9 or frame != int(frame):
            raise DatasetError(f"{path}:{line}: {' '.join(words[:2])[:80]!r} is no time and frame number")
        try:
            pose = pose_from_quaternion([row[k] for k in "xyz"], [row[k] for k in ("qx", "qy", "qz", "qw")])
        except KeyError as error:
            raise DatasetError(f"{path}: has no column {error.args[0]}") from None
        told = [row.get(key, 0.0) for key in ("fx", "fy", "cx", "cy")]
        camera = Camera(width, height, *told) if told[0] > 0.0 and told[1] > 0.0 else None
        found[int(frame)] = row["timestamp"], pose, camera
    return found


KIND = Kind("stray", "Stray Scanner: rgb.mp4, depth/, odometry.csv", recognises, open_sequence)
