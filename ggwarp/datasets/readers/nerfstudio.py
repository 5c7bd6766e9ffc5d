# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` of nerfstudio and instant-ngp, and recordings of the NeRFCapture app, which writes one.

``w h fl_x fl_y cx cy k1 k2 p1 p2`` for all frames or for each, ``frames`` with ``file_path``,
``transform_matrix`` (camera-to-world, OpenGL's axes) and, where there is depth, ``depth_file_path``
(nerfstudio: millimetres) or ``depth_path`` (NeRFCapture: units of ``integer_depth_scale`` metres). The
centre of the first pixel is (0.5, 0.5) there. Depth is of the picture's own pixels, bent as they are. Poses
are what structure from motion found: truth as good as that, at its scale.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import COLOUR_SUFFIXES, Size, image_size
from ggwarp.datasets.poses import opencv_axes, rigid
from ggwarp.datasets.rig import typical_camera
from ggwarp.datasets.sequence import Entry, FileSequence
from ggwarp.datasets.source import depth_elsewhere, recorder_source, unread_entries
from ggwarp.datasets.text import numbers_of, read_json
from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import finite_number
from ggwarp.io.printable import shown

_RATE = 30.0
_MILLIMETRES = 1000.0
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_LENS = ("k1", "k2", "p1", "p2", "k3")


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a recording in this layout."""
    return (path / "transforms.json").is_file()


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a recording.

    Raises:
        DatasetError: there are no frames, or the file is malformed.
    """
    file = path / "transforms.json"
    values = read_json(file)
    frames = values.get("frames")
    frames = [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []
    named = [(path / _image(path, frame, file), frame) for frame in frames]
    if not named:
        raise DatasetError(f"{file}: the sequence is empty (it names no frames)")
    model = values.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise DatasetError(f"{file}: camera_model is {shown(model)}; read are {', '.join(_MODELS)}")
    named.sort(key=lambda item: [int(number) for number in re.findall(r"\d+", item[0].name)])
    size = image_size([rgb for rgb, _ in named[:3]])
    cameras = [_camera(values | frame, size, file) for _, frame in named]
    lenses = {
        tuple(finite_number((values | frame).get(key, 0.0)) or 0.0 for key in _LENS) for _, frame in named
    }
    if len(lenses) > 1:
        raise DatasetError(f"{file}: its frames have several distortions; one lens is read")
    distortion = lenses.pop()
    metres = finite_number(values.get("integer_depth_scale"))
    scale = 1.0 / metres if metres and metres > 0.0 else _MILLIMETRES
    entries = []
    for i, ((rgb, frame), camera) in enumerate(zip(named, cameras, strict=True)):
        depth = next((frame[key] for key in ("depth_file_path", "depth_path") if key in frame), None)
        pose = numbers_of(frame.get("transform_matrix"), 16)
        stamp = finite_number(frame.get("timestamp"))
        entries.append(
            Entry(
                rgb,
                path / depth if isinstance(depth, str) and depth else None,
                i / _RATE if stamp is None else stamp,
                None if pose is None else opencv_axes(rigid(np.array(pose).reshape(4, 4))),
                camera=camera,
            )
        )
    bent = distortion if any(distortion) else ()
    calibration = Calibration(typical_camera(cameras), scale, bent, depth_distorted=True)
    read = {
        path / entry.relative_to(path).parts[0] for entry in _files(entries) if entry.is_relative_to(path)
    }
    unread = unread_entries(path, {file, *read})
    with_depth = any(entry.depth for entry in entries)
    remedy = f"{file.name} names no depth; give each frame its depth_file_path"
    source = recorder_source(
        "nerfstudio's layout, transforms.json",
        entries,
        camera="transforms.json",
        depth_unit=f"{scale:g} units a metre, " + ("from transforms.json" if metres else "nerfstudio's"),
        truth="transforms.json, with OpenGL's axes",
        notes=() if with_depth else depth_elsewhere(unread, remedy),
        unread=unread,
    )
    return FileSequence(path, "nerfstudio", entries, calibration, masks=masks, source=source)


def _files(entries: list[Entry]) -> Iterator[Path]:
    for entry in entries:
        yield from (file for file in (entry.rgb, entry.depth) if isinstance(file, Path))


def _image(path: Path, frame: dict[str, Any], file: Path) -> str:
    """Return a frame's image; NeRFCapture and the Blender scenes leave the suffix out."""
    name = frame.get("file_path")
    if not isinstance(name, str) or not name or "\x00" in name:
        raise DatasetError(f"{file}: file_path is {shown(name)}; it must name an image")
    if Path(name).suffix.lower() in COLOUR_SUFFIXES:
        return name
    return next((name + suffix for suffix in COLOUR_SUFFIXES if (path / (name + suffix)).is_file()), name)


def _camera(values: dict[str, Any], size: Size, file: Path) -> Camera:
    told = [finite_number(values.get(key)) for key in ("w", "h")]
    width, height = (int(told[i] or size[i]) for i in (0, 1))
    focal = finite_number(values.get("fl_x"))
    angle = finite_number(values.get("camera_angle_x"))
    if focal is None and angle is not None and 0.0 < angle < math.pi:
        focal = 0.5 * width / math.tan(0.5 * angle)
    if focal is None or focal <= 0.0:
        raise DatasetError(
            f"{file}: fl_x is {shown(values.get('fl_x'))}; it must be a focal length in pixels"
        )
    vertical = finite_number(values.get("fl_y")) or focal
    cx, cy = (finite_number(values.get(key)) for key in ("cx", "cy"))
    cx, cy = (0.5 * width if cx is None else cx), (0.5 * height if cy is None else cy)
    camera = Camera(width, height, focal, vertical, cx - 0.5, cy - 0.5)
    return camera if (width, height) == size else camera.resized(*size)


KIND = Kind("nerfstudio", "nerfstudio, NeRFCapture: transforms.json", recognises, open_sequence)
