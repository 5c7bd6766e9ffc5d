# SPDX-License-Identifier: Apache-2.0
"""Replica as NICE-SLAM renders it, and the recordings that others keep in that layout.

``<scene>/results/frame%06d.jpg`` and ``depth%06d.png`` (or ``images/`` and ``depth_images/``),
``<scene>/traj.txt`` (optional), ``cam_params.json`` in the scene or one folder up. And as Semantic-NeRF
and vMAP render it: ``rgb/``, ``depth/`` (millimetres), ``semantic_instance/`` and ``traj_w_c.txt``.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from ggwarp.datasets.base import DatasetError, Kind, MaskChoice, Masks
from ggwarp.datasets.calibration import CAMERA_FILES, Calibration, find_camera_file, read_calibration
from ggwarp.datasets.images import image_size
from ggwarp.datasets.pairing import pair_files
from ggwarp.datasets.poses import read_matrices
from ggwarp.datasets.sequence import Entry, FileSequence, image_files, match_poses
from ggwarp.datasets.source import Source, unread_entries
from ggwarp.geometry.camera import Camera

log = logging.getLogger(__name__)

_DEPTH_SCALE = 6553.5
_SEMANTIC_POSES = "traj_w_c.txt"
_RATE = 30.0
"""Frames a second; the layout has no times."""


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a scene in this layout: other programs have folders named results, too."""
    if (path / _SEMANTIC_POSES).is_file() and (path / "rgb").is_dir():
        return True
    if (path / "results").is_dir():
        others = any((path / name).is_dir() for name in ("color", "rgb"))
        return not others or any((path / "results").glob("frame*"))
    pictures = (path / "images").is_dir() and (path / "depth_images").is_dir()
    own = any((path / name).is_file() for name in CAMERA_FILES if name != "cam_params.json")
    return pictures and not own


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a scene, of NICE-SLAM's or Semantic-NeRF's rendering.

    Raises:
        DatasetError: no images, no camera file, or malformed numbers.
    """
    if (path / _SEMANTIC_POSES).is_file():
        return _open_semantic(path, masks)
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
    truth = path / "traj.txt"
    poses = read_matrices(truth) if truth.is_file() else []
    if poses and len(poses) != len(colour):
        log.warning(
            "%s: %d poses for %d images; each image takes the line of its number",
            truth,
            len(poses),
            len(colour),
        )
    pairing = pair_files(colour, depth, "colour images", "depth images")
    matched = zip(colour, pairing.partners, match_poses(colour, poses), strict=True)
    entries = [
        Entry(rgb, depth[d] if d >= 0 else None, i / _RATE, T_wc) for i, (rgb, d, T_wc) in enumerate(matched)
    ]
    known = sum(entry.T_wc is not None for entry in entries)
    folder = colour[0].parent
    read = {folder, truth, path / camera_file.name, *([depth[0].parent] if depth else [])}
    source = Source(
        layout=f"Replica's layout, {folder.name}/",
        pairing=pairing.summary("colour images", "depth images") if depth else "",
        truth=f"traj.txt, poses of {known} of {len(colour)} frames, camera-to-world" if poses else "",
        notes=tuple(pairing.notes),
        unread=unread_entries(path, read),
    )
    return FileSequence(path, "replica", entries, calibration, masks=masks, source=source)


def _open_semantic(path: Path, masks: Masks) -> FileSequence:
    """Open a scene as Semantic-NeRF and vMAP render it, with the data set's own instances as masks."""
    colour, depth = (
        image_files(path / "rgb"),
        image_files(path / "depth") if (path / "depth").is_dir() else [],
    )
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no images in rgb/)")
    width, height = image_size(colour[:3])
    # Its pictures are 90 degrees wide, by its authors' renderer.
    camera = Camera(width, height, 0.5 * width, 0.5 * width, 0.5 * (width - 1), 0.5 * (height - 1))
    pairing = pair_files(colour, depth, "colour images", "depth images")
    poses = match_poses(colour, read_matrices(path / _SEMANTIC_POSES))
    entries = [
        Entry(rgb, depth[d] if d >= 0 else None, i / _RATE, T_wc)
        for i, (rgb, d, T_wc) in enumerate(zip(colour, pairing.partners, poses, strict=True))
    ]
    known = sum(pose is not None for pose in poses)
    names = ("rgb", "depth", "semantic_instance", "semantic_class", _SEMANTIC_POSES)
    source = Source(
        layout="Replica as Semantic-NeRF renders it, rgb/ and depth/",
        pairing=pairing.summary("colour images", "depth images") if depth else "",
        camera="what its renderer is known for, 90 degrees wide",
        depth_unit="millimetres, as published",
        truth=f"{_SEMANTIC_POSES}, poses of {known} of {len(colour)} frames, camera-to-world",
        notes=tuple(pairing.notes),
        unread=unread_entries(path, [path / name for name in names]),
    )
    choice = MaskChoice.of(masks)
    if choice.where is None and (path / "semantic_instance").is_dir():
        choice = replace(choice, where=path / "semantic_instance")
    calibration = Calibration(camera, 1000.0)
    return FileSequence(path, "replica", entries, calibration, masks=choice, source=source)


KIND = Kind("replica", "results/ (or images/ and depth_images/)", recognises, open_sequence)
