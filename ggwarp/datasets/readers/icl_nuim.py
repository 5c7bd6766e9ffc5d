# SPDX-License-Identifier: Apache-2.0
"""ICL-NUIM's living room and office, the PNG version that resembles TUM's.

``rgb/N.png``, ``depth/N.png`` (5000 a metre) and ``*.gt.freiburg``, beside them or one folder up: number of
the frame, position, quaternion x y z w. The camera's fy is published as -480: its y points up, and so does
the world's, which makes both left-handed. Poses are mirrored in y here, so that fy is 480 and y points down.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.poses import read_numbered
from ggwarp.datasets.sequence import Entry, FileSequence, image_files
from ggwarp.datasets.source import recorder_source, whole_numbers
from ggwarp.geometry.camera import Camera

_CAMERA = Calibration(
    Camera(640, 480, 481.2, 480.0, 319.5, 239.5),
    5000.0,
    origin="ICL-NUIM's own, fy made positive",
    scale_origin="ICL-NUIM",
)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_RATE = 30.0


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a sequence in this layout."""
    return (path / "rgb").is_dir() and (path / "depth").is_dir() and any(path.glob("*.gt.freiburg"))


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a sequence.

    Raises:
        DatasetError: there are no images, or a file is malformed.
    """
    colour, depth = (whole_numbers(image_files(path / name)) for name in ("rgb", "depth"))
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no numbered images in rgb/)")
    truth = sorted(path.glob("*.gt.freiburg"))[0]
    poses = {
        number: None if pose is None else _MIRROR @ pose @ _MIRROR
        for number, pose in read_numbered(truth).items()
    }
    entries = [
        Entry(rgb, depth.get(number), number / _RATE, poses.get(number))
        for number, rgb in sorted(colour.items())
    ]
    source = recorder_source(
        "ICL-NUIM, rgb/ and depth/",
        entries,
        camera=_CAMERA.origin,
        depth_unit=_CAMERA.unit_in_words,
        truth=f"{truth.name}, mirrored in y",
    )
    return FileSequence(path, "icl-nuim", entries, _CAMERA, masks=masks, source=source)


KIND = Kind("icl-nuim", "ICL-NUIM: rgb/, depth/ and *.gt.freiburg", recognises, open_sequence)
