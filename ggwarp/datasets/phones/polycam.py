# SPDX-License-Identifier: Apache-2.0
"""Raw data of the Polycam app (LiDAR scans, exported with the developer mode on).

``keyframes/`` holds ``images``, ``cameras``, ``depth`` (millimetres) and ``confidence`` (0, 127, 255), named
by microseconds, and after the app's own bundle adjustment ``corrected_images`` and ``corrected_cameras``,
which go before. A camera is JSON with fx fy cx cy width height and t_00 .. t_23, camera-to-world by rows with
the axes of ARKit (y up, z back).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import DEPTH_SUFFIXES
from ggwarp.datasets.poses import opencv_axes, rigid
from ggwarp.datasets.rig import typical_camera
from ggwarp.datasets.sequence import Entry, FileSequence, image_files
from ggwarp.datasets.source import recorder_source, whole_numbers
from ggwarp.datasets.text import numbers_of, read_json
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float64

_POSE = [f"t_{row}{column}" for row in range(3) for column in range(4)]
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a recording in this layout."""
    return (path / "keyframes" / "images").is_dir() or (path / "keyframes" / "corrected_images").is_dir()


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a recording.

    Raises:
        DatasetError: there are no images, or a camera is malformed.
    """
    folder = path / "keyframes"
    corrected = all((folder / f"corrected_{name}").is_dir() for name in ("images", "cameras"))
    prefix = "corrected_" if corrected else ""
    colour = image_files(folder / f"{prefix}images")
    depth = image_files(folder / "depth", suffixes=DEPTH_SUFFIXES) if (folder / "depth").is_dir() else []
    by_stem = {file.stem: file for file in depth}
    numbers = whole_numbers(colour)
    first = min(numbers, default=0)
    entries = []
    for stamp, rgb in sorted(numbers.items()):
        file = folder / f"{prefix}cameras" / f"{rgb.stem}.json"
        if not file.is_file():
            continue
        camera, T_wc = _read_camera(file)
        confidence = folder / "confidence" / f"{rgb.stem}.png"
        sure = confidence if confidence.is_file() else None
        entries.append(
            Entry(rgb, by_stem.get(rgb.stem), (stamp - first) / 1e6, T_wc, camera=camera, confidence=sure)
        )
    if not entries:
        raise DatasetError(f"{folder}: the sequence is empty (no {prefix}images/ with {prefix}cameras/)")
    camera = typical_camera([entry.camera for entry in entries if entry.camera])
    source = recorder_source(
        f"Polycam's raw data, {prefix}images",
        entries,
        camera=f"{prefix}cameras, frame by frame",
        depth_unit="millimetres, as the app writes",
        truth=f"{prefix}cameras, by {'the app' if corrected else 'ARKit'}",
    )
    return FileSequence(path, "polycam", entries, Calibration(camera, 1000.0), masks=masks, source=source)


def _read_camera(path: Path) -> tuple[Camera, Float64 | None]:
    values = read_json(path)
    numbers = numbers_of([values.get(key) for key in _CAMERA], 6)
    if numbers is None:
        raise DatasetError(f"{path}: lacks one of {', '.join(_CAMERA)}; export the raw data again")
    pose = numbers_of([values.get(key) for key in _POSE], 12)
    T_wc = None if pose is None else opencv_axes(rigid(np.array(pose).reshape(3, 4)))
    return Camera(int(numbers[0]), int(numbers[1]), *numbers[2:]), T_wc


KIND = Kind("polycam", "Polycam's raw data: keyframes/", recognises, open_sequence)
