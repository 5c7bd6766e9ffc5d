# SPDX-License-Identifier: Apache-2.0
"""7-Scenes and BundleFusion as they are distributed: all files of a sequence in one folder.

``frame-%06d.color.png`` (or .jpg), ``.depth.png`` (millimetres; 65535 or 0 is no reading), ``.pose.txt``
(camera-to-world). BundleFusion's ``info.txt`` tells both cameras. 7-Scenes tells none and is not registered:
its depth has the focal length that its authors name, 585 pixels, its colour the Kinect's 525, and between
them is what the LIRIS laboratory measured of a Kinect, as scene coordinate regression takes it (DSAC*, ACE).
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import (
    CAMERA_FILES,
    Calibration,
    Intrinsics,
    find_camera_file,
    given_camera,
    read_calibration,
)
from ggwarp.datasets.images import Size, image_size
from ggwarp.datasets.poses import read_matrix_files
from ggwarp.datasets.rig import Lens
from ggwarp.datasets.sequence import Entry, FileSequence, image_files
from ggwarp.datasets.source import recorder_source
from ggwarp.datasets.text import read_text
from ggwarp.geometry.camera import Camera

_RATE = 30.0
_MILLIMETRES = 1000.0
_KINECT = Calibration(
    Camera(640, 480, 525.0, 525.0, 320.0, 240.0),
    _MILLIMETRES,
    depth=Lens(Camera(640, 480, 585.0, 585.0, 320.0, 240.0)),
    T_colour_depth=np.array(
        [
            [0.99996518, 0.00267651, -0.00790410, -0.02555894],
            [-0.00274093, 0.99996303, -0.00815045, 0.00010110],
            [0.00788199, 0.00817183, 0.99993554, 0.00203183],
            [0.0, 0.0, 0.0, 1.0],
        ]
    ),
)


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a sequence in this layout."""
    return any(path.glob("frame-*.color.*"))


def open_sequence(path: Path, masks: Masks = None, intrinsics: Intrinsics | None = None) -> FileSequence:
    """Open a sequence.

    Args:
        intrinsics: of the colour; go before a camera file.

    Raises:
        DatasetError: there are no images, their camera is not known, or a file is malformed.
    """
    colour = [file for file in image_files(path, "frame-") if file.stem.endswith(".color")]
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no frame-000000.color.png or .jpg)")
    stems = [rgb.stem.removesuffix(".color") for rgb in colour]
    files = [path / f"{stem}.pose.txt" for stem in stems]
    poses = read_matrix_files([file if file.is_file() else None for file in files])
    entries = []
    for i, (rgb, stem, T_wc) in enumerate(zip(colour, stems, poses, strict=True)):
        depth = path / f"{stem}.depth.png"
        entries.append(Entry(rgb, depth if depth.is_file() else None, i / _RATE, T_wc))
    calibration = _calibration(path, image_size(colour[:3]), intrinsics)
    source = recorder_source(
        "7-Scenes' layout, frame-*.color and .depth",
        entries,
        camera=calibration.origin or "what is known of 7-Scenes' Kinect",
        depth_unit=calibration.depth_unit if calibration.scale_origin else "millimetres, as published",
        truth="frame-*.pose.txt, camera-to-world",
    )
    return FileSequence(path, "7-scenes", entries, calibration, masks=masks, source=source)


def _calibration(path: Path, size: Size, intrinsics: Intrinsics | None) -> Calibration:
    if any((path / name).is_file() for name in CAMERA_FILES):
        found = read_calibration(find_camera_file([path]), depth_scale=_MILLIMETRES, size=size)
        given = None if intrinsics is None else given_camera(path, size, intrinsics)
        return found if given is None else replace(found, camera=given, origin="--intrinsics")
    if intrinsics is not None:
        return Calibration(given_camera(path, size, intrinsics), _MILLIMETRES, origin="--intrinsics")
    for info in (path / "info.txt", path.parent / "info.txt"):
        if info.is_file():
            return _info(info, size)
    if size == (_KINECT.camera.width, _KINECT.camera.height):
        return _KINECT
    raise DatasetError(
        f"{path}: its camera is not known; write a camera.json there, or give --intrinsics FX FY CX CY in "
        f"pixels of its {size[0]}x{size[1]} images"
    )


def _info(path: Path, size: Size) -> Calibration:
    """Read BundleFusion's ``info.txt``: lines of ``name = values``."""
    values = dict(re.findall(r"^\s*(\w+)\s*=\s*(.*?)\s*$", read_text(path), re.MULTILINE))

    def numbers(key: str) -> list[float]:
        try:
            found = [float(word) for word in values.get(key, "").split()]
        except ValueError:
            found = [np.nan]
        if not np.isfinite(found).all():
            raise DatasetError(f"{path}: {key} is not made of finite numbers; copy it again")
        return found

    def camera(name: str, size: Size) -> Camera | None:
        K = numbers(f"m_calibration{name}Intrinsic")
        return Camera(*size, K[0], K[5], K[2], K[6]) if len(K) == 16 else None

    colour = camera("Color", size)
    if colour is None:
        raise DatasetError(f"{path}: has no m_calibrationColorIntrinsic of 16 numbers; copy it again")
    sides = [numbers(key) for key in ("m_depthWidth", "m_depthHeight")]
    depth_size = (int(sides[0][0]), int(sides[1][0])) if all(sides) else size
    depth = camera("Depth", depth_size)
    shift = numbers("m_depthShift")
    lens = None if depth is None or depth == colour.resized(*depth_size) else Lens(depth)
    scale = shift[0] if shift and shift[0] > 0 else _MILLIMETRES
    return Calibration(colour, scale, depth=lens, origin=path.name, scale_origin=path.name)


KIND = Kind(
    "7-scenes",
    "7-Scenes, BundleFusion: frame-000000.color.png",
    recognises,
    open_sequence,
    takes_intrinsics=True,
)
