# SPDX-License-Identifier: Apache-2.0
"""Replica as NICE-SLAM renders it, and the recordings that others keep in that layout.

``<scene>/results/frame%06d.jpg`` and ``depth%06d.png`` (or ``images/`` and ``depth_images/``),
``<scene>/traj.txt`` (optional), ``cam_params.json`` in the scene or one folder up.
"""

from __future__ import annotations

import logging
from pathlib import Path

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import find_camera_file, read_calibration
from ggwarp.datasets.images import image_size
from ggwarp.datasets.poses import read_matrices
from ggwarp.datasets.sequence import Entry, FileSequence, image_files, match_by_number, match_poses

log = logging.getLogger(__name__)

_DEPTH_SCALE = 6553.5
_RATE = 30.0
"""Frames a second; the layout has no times."""


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a scene in this layout."""
    return (path / "results").is_dir() or ((path / "images").is_dir() and (path / "depth_images").is_dir())


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a scene.

    Raises:
        DatasetError: no images, no camera file, or malformed numbers.
    """
    if (path / "results").is_dir():
        colour, depth = image_files(path / "results", "frame"), image_files(path / "results", "depth")
    else:
        colour, depth = image_files(path / "images"), image_files(path / "depth_images")
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no results/frame*.jpg, nor images in images/)")
    # Resolved first: the folder above a link is not where its scene's camera file lies.
    scene = path.resolve()
    camera_file = find_camera_file([scene, scene.parent], ["cam_params.json"])
    calibration = read_calibration(camera_file, depth_scale=_DEPTH_SCALE, size=image_size(colour[:3]))
    poses = read_matrices(path / "traj.txt") if (path / "traj.txt").is_file() else []
    if poses and len(poses) != len(colour):
        log.warning(
            "%s: %d poses for %d images; each image takes the line of its number",
            path / "traj.txt",
            len(poses),
            len(colour),
        )
    matched = zip(colour, match_by_number(colour, depth), match_poses(colour, poses), strict=True)
    entries = [Entry(rgb, d, i / _RATE, T_wc) for i, (rgb, d, T_wc) in enumerate(matched)]
    return FileSequence(path, "replica", entries, calibration, masks=masks)


KIND = Kind("replica", "results/ (or images/ and depth_images/)", recognises, open_sequence)
