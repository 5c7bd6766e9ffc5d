# SPDX-License-Identifier: Apache-2.0
"""ScanNet as its own tools export it.

``color/N.jpg`` (1296x968), ``depth/N.png`` (640x480, millimetres), ``pose/N.txt`` (camera-to-world; infinite
where tracking was lost) and ``intrinsic/intrinsic_color.txt``, ``intrinsic_depth.txt``,
``extrinsic_color.txt``, ``extrinsic_depth.txt``, 4x4 each. A ``.sens`` file is
:mod:`ggwarp.datasets.readers.sens`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import DEPTH_SUFFIXES, Size, image_size, read_depth, size_of
from ggwarp.datasets.poses import read_matrix_files, rigid
from ggwarp.datasets.rig import Lens
from ggwarp.datasets.sequence import Entry, FileSequence, image_files
from ggwarp.datasets.source import recorder_source
from ggwarp.datasets.text import read_numbers
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float64

_RATE = 30.0
_MILLIMETRES = 1000.0
_SAME_PLACE = 1e-4
"""Metres and radians: the extrinsics of ScanNet are the identity, but for rounding."""


def recognises(path: Path) -> bool:
    """Return whether ``path`` is an exported scene."""
    return (path / "intrinsic" / "intrinsic_color.txt").is_file() and (path / "color").is_dir()


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a scene.

    Raises:
        DatasetError: there are no images, or a file is malformed.
    """
    colour = image_files(path / "color")
    depth = image_files(path / "depth", suffixes=DEPTH_SUFFIXES) if (path / "depth").is_dir() else []
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no images in color/)")
    size = image_size(colour[:3])
    camera = _camera(path / "intrinsic" / "intrinsic_color.txt", size)
    depth_size = size_of(read_depth(depth[0], scale=_MILLIMETRES)) if depth else size
    own = path / "intrinsic" / "intrinsic_depth.txt"
    lens = _camera(own, depth_size) if depth and own.is_file() else None
    files = [path / "pose" / f"{rgb.stem}.txt" for rgb in colour]
    poses = read_matrix_files([file if file.is_file() else None for file in files])
    by_stem = {file.stem: file for file in depth}
    entries = [
        Entry(rgb, by_stem.get(rgb.stem), i / _RATE, T_wc)
        for i, (rgb, T_wc) in enumerate(zip(colour, poses, strict=True))
    ]
    T = _colour_from_depth(path / "intrinsic")
    source = recorder_source(
        "ScanNet's export, color/ and depth/",
        entries,
        camera="intrinsic/",
        depth_unit="millimetres, as published",
        truth="pose/, by BundleFusion",
    )
    found = calibration(camera, lens, T, _MILLIMETRES)
    return FileSequence(path, "scannet", entries, found, masks=masks, source=source)


def calibration(colour: Camera, depth: Camera | None, T: Float64 | None, scale: float) -> Calibration:
    """Return what depth of another camera needs: nothing, another view, or to be registered.

    Args:
        depth: None: depth shows what the colour does.
        T: [4, 4] takes points of the depth camera to the colour camera; None: the same place.
        scale: raw depth / scale = metres.
    """
    if T is not None and np.abs(se3.se3_log(T)).max() < _SAME_PLACE:
        T = None
    if depth is None or (T is None and depth == colour):
        return Calibration(colour, scale)
    return Calibration(colour, scale, depth=Lens(depth), T_colour_depth=T)


def _camera(path: Path, size: Size) -> Camera:
    K = [values for _, values in read_numbers(path)]
    if len(K) not in (3, 4) or any(len(row) != len(K) for row in K):
        raise DatasetError(f"{path}: expected a 4x4 matrix, found {len(K)} lines")
    return Camera(*size, K[0][0], K[1][1], K[0][2], K[1][2])


def _colour_from_depth(folder: Path) -> Float64 | None:
    """Return the motion from the depth to the colour camera out of what takes each to the body."""
    found = []
    for name in ("extrinsic_color.txt", "extrinsic_depth.txt"):
        if not (folder / name).is_file():
            return None
        values = [value for _, row in read_numbers(folder / name) for value in row]
        T = rigid(np.array(values).reshape(4, 4)) if len(values) == 16 else None
        if T is None:
            raise DatasetError(f"{folder / name}: is no rigid motion; export it again")
        found.append(T)
    return se3.inverse(found[0]) @ found[1]


KIND = Kind("scannet", "ScanNet's export: color/, depth/, intrinsic/", recognises, open_sequence)
