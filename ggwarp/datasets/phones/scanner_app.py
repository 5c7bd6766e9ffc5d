# SPDX-License-Identifier: Apache-2.0
"""Raw data of the 3D Scanner App (LiDAR, "all data").

``frame_%05d.json`` has ``cameraPoseARFrame`` (16 numbers by rows, camera-to-world with the axes of ARKit),
``intrinsics`` (9 by rows) and ``time``; ``frame_%05d.jpg`` is there for some frames only, ``depth_%05d.png``
(millimetres) and ``conf_%05d.png`` (0 to 2) for all. Frames with colour are read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration, has_camera_file
from ggwarp.datasets.images import image_size
from ggwarp.datasets.poses import opencv_axes, rigid
from ggwarp.datasets.rig import typical_camera
from ggwarp.datasets.sequence import Entry, FileSequence, image_files
from ggwarp.datasets.source import recorder_source
from ggwarp.datasets.text import numbers_of, read_json
from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import finite_number

_RATE = 60.0


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a recording in this layout."""
    ours = any(path.glob("frame_[0-9]*.json")) and any(path.glob("frame_[0-9]*.jpg"))
    return ours and not has_camera_file(path)


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a recording.

    Raises:
        DatasetError: no picture has its JSON, or one is malformed.
    """
    colour = [file for file in image_files(path, "frame_") if file.with_suffix(".json").is_file()]
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no frame_00000.jpg with frame_00000.json)")
    width, height = image_size(colour[:3])
    entries = []
    for i, rgb in enumerate(colour):
        values = read_json(rgb.with_suffix(".json"))
        K = numbers_of(values.get("intrinsics"), 9)
        if K is None:
            raise DatasetError(
                f"{rgb.with_suffix('.json')}: intrinsics are not nine numbers; export it again"
            )
        pose = numbers_of(values.get("cameraPoseARFrame"), 16)
        stamp = finite_number(values.get("time"))
        number = rgb.stem.removeprefix("frame_")
        depth, confidence = path / f"depth_{number}.png", path / f"conf_{number}.png"
        entries.append(
            Entry(
                rgb,
                depth if depth.is_file() else None,
                i / _RATE if stamp is None else stamp,
                None if pose is None else opencv_axes(rigid(np.array(pose).reshape(4, 4))),
                camera=Camera(width, height, K[0], K[4], K[2], K[5]),
                confidence=confidence if confidence.is_file() else None,
            )
        )
    camera = typical_camera([entry.camera for entry in entries if entry.camera])
    source = recorder_source(
        "3D Scanner App, frame_*.jpg and .json",
        entries,
        camera="frame_*.json, frame by frame",
        depth_unit="millimetres, as the app writes",
        truth="frame_*.json, by ARKit",
    )
    return FileSequence(path, "scanner-app", entries, Calibration(camera, 1000.0), masks=masks, source=source)


KIND = Kind("scanner-app", "3D Scanner App: frame_00000.jpg and .json", recognises, open_sequence)
