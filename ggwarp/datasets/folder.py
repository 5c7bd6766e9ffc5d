# SPDX-License-Identifier: Apache-2.0
"""A plain folder: one's own recording.

``color/``, ``rgb/`` or ``images/`` and ``depth/``, paired by name or number; a camera file (see
:mod:`ggwarp.datasets.calibration`); poses optional, in ``traj.txt`` or ``pose/<stem>.txt``. Without
``depth/`` it is monocular; then the images may also lie in the folder itself.
"""

from __future__ import annotations

from pathlib import Path

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import (
    CAMERA_FILES,
    Calibration,
    Intrinsics,
    find_camera_file,
    given_camera,
    read_calibration,
)
from ggwarp.datasets.images import COLOUR_SUFFIXES, DEPTH_SUFFIXES, image_size
from ggwarp.datasets.poses import read_matrices, read_matrix
from ggwarp.datasets.sequence import Entry, FileSequence, image_files, match_by_number, match_poses
from ggwarp.types import Float64

COLOUR_FOLDERS = ("color", "rgb", "images")
POSE_FOLDERS = ("pose", "poses")
_DEPTH_SCALE = 1000.0
"""Millimetres, as most recorders write."""
_RATE = 30.0


def recognises(path: Path) -> bool:
    """Return whether ``path`` has a colour folder, or is one."""
    return _colour_folder(path) is not None


def open_sequence(path: Path, masks: Masks = None, intrinsics: Intrinsics | None = None) -> FileSequence:
    """Open a folder.

    Args:
        intrinsics: go before a camera file.

    Raises:
        DatasetError: no images, no camera file, or malformed numbers.
    """
    folder = _colour_folder(path)
    colour = image_files(folder) if folder else []
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no images in {', '.join(COLOUR_FOLDERS)})")
    depth = image_files(path / "depth", suffixes=DEPTH_SUFFIXES) if (path / "depth").is_dir() else []
    size = image_size(colour[:3])
    if intrinsics is not None or not (depth or _camera_file(path)):
        calibration = Calibration(given_camera(path, size, intrinsics), _DEPTH_SCALE)
    else:
        calibration = read_calibration(find_camera_file([path]), depth_scale=_DEPTH_SCALE, size=size)
    matched = zip(colour, match_by_number(colour, depth), _poses(path, colour), strict=True)
    entries = [Entry(rgb, d, i / _RATE, T_wc) for i, (rgb, d, T_wc) in enumerate(matched)]
    if depth and not any(entry.depth for entry in entries):
        raise DatasetError(
            f"{path}: no image in depth/ has the name or number of one in {colour[0].parent.name}/ "
            f"({depth[0].name}, {colour[0].name})"
        )
    return FileSequence(path, "folder", entries, calibration, masks=masks)


def _colour_folder(path: Path) -> Path | None:
    inside = next((path / name for name in COLOUR_FOLDERS if (path / name).is_dir()), None)
    if inside is not None or (path / "depth").is_dir():
        return inside
    return path if any(p.suffix.lower() in COLOUR_SUFFIXES for p in path.iterdir()) else None


def _camera_file(path: Path) -> bool:
    return any((path / name).is_file() for name in CAMERA_FILES)


def _poses(path: Path, colour: list[Path]) -> list[Float64 | None]:
    if (path / "traj.txt").is_file():
        return match_poses(colour, read_matrices(path / "traj.txt"))
    folder = next((path / name for name in POSE_FOLDERS if (path / name).is_dir()), None)
    if folder is None:
        return [None] * len(colour)
    files = match_by_number(colour, sorted(folder.glob("*.txt")))
    return [read_matrix(file) if file else None for file in files]


KIND = Kind(
    "folder", "color/, rgb/ or images/ and, if there, depth/; or images", recognises, open_sequence, True
)
