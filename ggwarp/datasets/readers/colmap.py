# SPDX-License-Identifier: Apache-2.0
"""A COLMAP reconstruction: ``images/`` and ``sparse/0/``, ``sparse/`` or the folder itself with the model.

The model is ``cameras`` and ``images``, ``.bin`` or ``.txt``: world-to-camera, quaternion w first, the
centre of the first pixel at (0.5, 0.5). Depth, if any, is in ``depth/`` by the images' names, of their own
pixels, bent as they are, millimetres at the model's scale. Poses are truth as good as structure from motion
found them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import DEPTH_SUFFIXES
from ggwarp.datasets.poses import pose_from_quaternion
from ggwarp.datasets.rig import Lens, typical_camera
from ggwarp.datasets.sequence import Entry, FileSequence
from ggwarp.datasets.source import depth_elsewhere, recorder_source, unread_entries
from ggwarp.datasets.text import parse_float, read_lines, read_text
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.io import guarded
from ggwarp.io.printable import printable
from ggwarp.types import Float64

_RATE = 30.0
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
"""Number of a camera's model -> its name and how many parameters it has."""
_TABLES = ("cameras", "images", "points3D")
_LONGEST_NAME = 4096

Images = list[tuple[str, int, Float64 | None]]
"""Name, number of the camera and pose."""


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a reconstruction."""
    return _model(path) is not None and (path / "images").is_dir()


def _model(path: Path) -> Path | None:
    folders = (path / "sparse" / "0", path / "sparse", path)
    return next((f for f in folders for s in ("bin", "txt") if _both(f, s)), None)


def _both(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images"))


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a reconstruction.

    Raises:
        DatasetError: it has no images, is damaged, or has a lens that is not read.
    """
    folder = _model(path)
    assert folder is not None, "recognised"
    if _both(folder, "bin"):
        lenses, images = _cameras_bin(folder / "cameras.bin"), _images_bin(folder / "images.bin")
    else:
        lenses, images = _cameras_txt(folder / "cameras.txt"), _images_txt(folder / "images.txt")
    if not images:
        raise DatasetError(f"{folder}: the sequence is empty (no image has a pose)")
    images.sort(key=lambda image: image[0])
    used = {camera for _, camera, _ in images}
    if missing := used - set(lenses):
        raise DatasetError(f"{folder}: images name camera {min(missing)}, which is not among the cameras")
    if len({lenses[camera].distortion for camera in used}) > 1:
        raise DatasetError(f"{folder}: its cameras have several distortions; run COLMAP's image_undistorter")
    entries = []
    for i, (name, camera, T_wc) in enumerate(images):
        entries.append(
            Entry(path / "images" / name, _depth(path, name), i / _RATE, T_wc, camera=lenses[camera].camera)
        )
    typical = typical_camera([lenses[camera].camera for _, camera, _ in images])
    distortion = lenses[images[0][1]].distortion
    read = ("images", "sparse", "depth", *(f"{n}.{s}" for n in _TABLES for s in ("bin", "txt")))
    unread = unread_entries(path, [path / name for name in read])
    with_depth = any(entry.depth for entry in entries)
    source = recorder_source(
        f"COLMAP, images/ and {folder.relative_to(path)}",
        entries,
        camera=f"cameras of {folder.relative_to(path)}",
        depth_unit="millimetres at the model's scale, assumed",
        truth="structure from motion, world-to-camera",
        notes=()
        if with_depth
        else depth_elsewhere(unread, "depth is read from depth/, by the images' names"),
        unread=unread,
    )
    calibration = Calibration(typical, 1000.0, distortion, depth_distorted=True)
    return FileSequence(path, "colmap", entries, calibration, masks=masks, source=source)


def _depth(path: Path, name: str) -> Path | None:
    stem = (path / "depth" / name).with_suffix("")
    return next((file for s in DEPTH_SUFFIXES if (file := stem.with_name(stem.name + s)).is_file()), None)


def _lens(model: str, width: int, height: int, p: list[float], path: Path) -> Lens:
    """Return a camera of COLMAP's, whose parameters are focal lengths, centre, distortion."""
    if model not in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"):
        raise DatasetError(
            f"{path}: its lens, {printable(model)[:40]}, is not read; run COLMAP's image_undistorter first"
        )
    if not np.isfinite(p).all() or not (0 < width < 1 << 20 and 0 < height < 1 << 20):
        raise DatasetError(f"{path}: holds a camera that cannot be; copy it again")
    two = model in ("PINHOLE", "OPENCV", "FULL_OPENCV")
    fx, fy, (cx, cy), rest = p[0], p[1] if two else p[0], p[1 + two : 3 + two], p[3 + two :]
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        rest = [*rest, *[0.0] * (4 - len(rest))]
    camera = Camera(width, height, fx, fy, cx - 0.5, cy - 0.5)
    return Lens(camera, tuple(rest) if any(rest) else ())


def _pose(q: list[float], t: list[float]) -> Float64 | None:
    """Return camera-to-world of world-to-camera, w first."""
    T_cw = pose_from_quaternion(t, [*q[1:], q[0]])
    return None if T_cw is None else se3.inverse(T_cw)


def _cameras_txt(path: Path) -> dict[int, Lens]:
    lenses = {}
    for line, words in read_lines(path):
        values = [parse_float(word, path, line) for word in [words[0], *words[2:]]]
        counts = [count for name, count in _MODELS.values() if len(words) > 1 and name == words[1]]
        if (counts and len(values) != 3 + counts[0]) or len(values) < 4:
            raise DatasetError(f"{path}:{line}: expected a number, a model, width, height and its parameters")
        lenses[_whole(values[0], path, line)] = _lens(
            words[1], _whole(values[1], path, line), _whole(values[2], path, line), values[3:], path
        )
    return lenses


def _images_txt(path: Path) -> Images:
    """Read lines in pairs: an image, and its points, which may be none."""
    lines = [line for line in enumerate(read_text(path).splitlines(), 1) if not line[1].startswith("#")]
    images: Images = []
    for number, line in lines[::2]:
        words = line.split(maxsplit=9)
        if not words:
            continue
        if len(words) != 10:
            raise DatasetError(
                f"{path}:{number}: expected a number, a quaternion, a position, a camera, a name"
            )
        values = [parse_float(word, path, number) for word in words[1:9]]
        images.append((words[9].strip(), _whole(values[7], path, number), _pose(values[:4], values[4:7])))
    return images


def _whole(value: float, path: Path, line: int) -> int:
    if not 0 <= value < 1 << 32 or value != int(value):
        raise DatasetError(f"{path}:{line}: {value:g} is no whole number")
    return int(value)


def _cameras_bin(path: Path) -> dict[int, Lens]:
    lenses = {}
    for file in _records(path):
        number, model, width, height = struct.unpack("<IiQQ", _exactly(file, 24, path))
        if model not in _MODELS:
            raise DatasetError(
                f"{path}: its lens, number {model}, is not known; run COLMAP's image_undistorter"
            )
        name, count = _MODELS[model]
        p = list(struct.unpack(f"<{count}d", _exactly(file, 8 * count, path)))
        lenses[number] = _lens(name, width, height, p, path)
    return lenses


def _images_bin(path: Path) -> Images:
    images: Images = []
    for file in _records(path):
        values = struct.unpack("<I7dI", _exactly(file, 64, path))
        name = b""
        while (letter := _exactly(file, 1, path)) != b"\x00":
            name += letter
            if len(name) > _LONGEST_NAME:
                raise DatasetError(f"{path}: a name in it never ends; copy it again")
        (points,) = struct.unpack("<Q", _exactly(file, 8, path))
        if points > guarded.MAP.limit // 24:
            raise DatasetError(f"{path}: claims {points:,} points in an image; copy it again")
        file.seek(24 * points, 1)
        pose = _pose(list(values[1:5]), list(values[5:8]))
        images.append((name.decode("utf-8", "replace"), values[8], pose))
    return images


def _records(path: Path) -> Iterator[BinaryIO]:
    """Yield the file at each of its records; they are as many as its head says."""
    try:
        with guarded.open_file(path, guarded.MAP) as file:
            (count,) = struct.unpack("<Q", _exactly(file, 8, path))
            for _ in range(count):
                yield file
    except guarded.FileError as error:
        raise DatasetError(str(error)) from error


def _exactly(file: BinaryIO, count: int, path: Path) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise DatasetError(f"{path}: is truncated; copy it again")
    return data


KIND = Kind("colmap", "COLMAP: images/ and sparse/", recognises, open_sequence)
