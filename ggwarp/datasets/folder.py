# SPDX-License-Identifier: Apache-2.0
"""A plain folder: one's own recording.

``color/``, ``rgb/`` or ``images/`` and ``depth/``, paired by name, number or time (see
:mod:`ggwarp.datasets.pairing`), or one folder of ``0_color`` and ``0_depth``; a camera file (see
:mod:`ggwarp.datasets.calibration`); poses optional, in ``traj.txt`` or ``pose/<stem>.txt``. Without depth it
is monocular; then the images may also lie in the folder itself.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import (
    CAMERA_FILES,
    Calibration,
    Intrinsics,
    find_camera_file,
    given_camera,
    has_camera_file,
    read_calibration,
)
from ggwarp.datasets.images import COLOUR_SUFFIXES, DEPTH_SUFFIXES, image_size
from ggwarp.datasets.pairing import Pairing, pair_files, several_cameras
from ggwarp.datasets.plan.bent_depth import LEAST_PREFERENCE, preference
from ggwarp.datasets.poses import read_matrices, read_matrix_files
from ggwarp.datasets.sequence import Entry, FileSequence, image_files, match_poses
from ggwarp.datasets.source import Source, contents, depth_elsewhere, unread_entries
from ggwarp.types import Float64

COLOUR_FOLDERS = ("color", "rgb", "images", "colour")
DEPTH_FOLDERS = ("depth", "depths", "depth_images")
POSE_FOLDERS = ("pose", "poses")
_COLOUR = re.compile(r"(?i)colou?r|rgb")
_DEPTH_SCALE = 1000.0
"""Millimetres, as most recorders write."""
_RATE = 30.0


def recognises(path: Path) -> bool:
    """Return whether ``path`` has a colour folder, or is one."""
    return _colour_folder(path) is not None


def open_sequence(path: Path, masks: Masks = None, intrinsics: Intrinsics | None = None) -> FileSequence:
    """Open a folder.

    Args:
        intrinsics: go before a camera file's; its depth scale and distortion stay.

    Raises:
        DatasetError: no images, no camera file, malformed numbers, or names that do not tell what belongs
            together.
    """
    folder = _colour_folder(path)
    colour = image_files(folder) if folder else []
    if not colour or folder is None:
        found = "" if folder is None else f"; {folder.name}/ holds {contents(folder)}"
        raise DatasetError(f"{path}: the sequence is empty (no images in {', '.join(COLOUR_FOLDERS)}{found})")
    depth_folder = _first(path, DEPTH_FOLDERS)
    depth = image_files(depth_folder, suffixes=DEPTH_SUFFIXES) if depth_folder else []
    if depth_folder is None:
        colour, depth = _told_apart(folder, colour)
    _refuse_doubles(colour)
    if depth_folder is not None and not depth and any(depth_folder.iterdir()):
        raise DatasetError(
            f"{depth_folder}: holds {contents(depth_folder)}, but depth is read from "
            f"{', '.join(DEPTH_SUFFIXES)}; export it so, or move it away"
        )
    calibration = _calibration(path, image_size(colour[:3]), intrinsics, with_depth=bool(depth))
    pairing = pair_files(colour, depth, "colour images", "depth images")
    truth = _truth(path, colour)
    entries = _entries(colour, depth, pairing, truth.poses)
    known = {
        folder,
        *([depth_folder] if depth_folder else ()),
        *truth.read,
        *(path / n for n in CAMERA_FILES),
    }
    unread = unread_entries(path, {*known, *(colour + depth if folder == path else ())})
    where = f" and {depth_folder.name}/" if depth_folder else " with colour and depth" if depth else ""
    elsewhere = depth_elsewhere(unread, f"depth is read from {', '.join(f'{n}/' for n in DEPTH_FOLDERS)}")
    source = Source(
        layout=f"a plain folder, {folder.name}/{where}",
        pairing=pairing.summary("colour images", "depth images") if depth else "",
        truth=truth.text,
        notes=(
            *pairing.notes,
            *filter(None, [several_cameras(colour)]),
            *truth.notes,
            *([] if depth else elsewhere),
        ),
        unread=unread,
    )
    sequence = FileSequence(path, "folder", entries, calibration, masks=masks, source=source)
    if not (depth and calibration.distortion) or calibration.depth or calibration.depth_distorted is not None:
        return sequence
    bent = replace(calibration, depth_distorted=True)
    told = replace(source, depth_unit=f"{calibration.unit_in_words}; bent as the colour is, by its edges")
    other = FileSequence(path, "folder", entries, bent, masks=masks, source=told)
    prefers = preference(sequence, other)
    return other if prefers is not None and prefers > LEAST_PREFERENCE else sequence


def _refuse_doubles(colour: list[Path]) -> None:
    """Refuse images of one name and several kinds, each of which would be a frame."""
    seen: dict[str, Path] = {}
    for path in colour:
        if (other := seen.setdefault(path.stem, path)) is not path:
            raise DatasetError(f"{path.parent}: {other.name} and {path.name} have one name; keep one kind")


def _told_apart(folder: Path, images: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return the colour and the depth images of a ``folder`` of both, whose names say which is which."""
    depth = [path for path in image_files(folder, suffixes=DEPTH_SUFFIXES) if "depth" in path.stem.lower()]
    others = [path for path in images if path not in set(depth)]
    if not depth or not others:
        return images, []
    return [path for path in others if _COLOUR.search(path.stem)] or others, depth


def _calibration(
    path: Path, size: tuple[int, int], intrinsics: Intrinsics | None, *, with_depth: bool
) -> Calibration:
    """Return the camera file's calibration with ``intrinsics`` before its own, or that of these alone."""
    camera = None
    if intrinsics is not None or not (with_depth or has_camera_file(path)):
        camera = given_camera(path, size, intrinsics)
    if camera is not None and not has_camera_file(path):
        return Calibration(camera, _DEPTH_SCALE, origin="--intrinsics")
    file = find_camera_file([path])
    return read_calibration(file, depth_scale=_DEPTH_SCALE, size=size, intrinsics=intrinsics)


def _entries(
    colour: list[Path], depth: list[Path], pairing: Pairing, poses: list[Float64 | None]
) -> list[Entry]:
    """Return the frames, with the times that their names tell."""
    entries = []
    for i, (rgb, partner, T_wc) in enumerate(zip(colour, pairing.partners, poses, strict=True)):
        stamp, depth_stamp = i / _RATE, None
        if pairing.stamps is not None:
            stamp = float(pairing.stamps[0][i])
            depth_stamp = float(pairing.stamps[1][partner]) if partner >= 0 else None
        entries.append(Entry(rgb, depth[partner] if partner >= 0 else None, stamp, T_wc, depth_stamp))
    return entries


def _first(path: Path, names: tuple[str, ...]) -> Path | None:
    """Return the first of the folders ``names`` in ``path``, in any case; None: there is none."""
    there = {entry.name.lower(): entry for entry in sorted(path.iterdir(), reverse=True) if entry.is_dir()}
    return next((there[name] for name in names if name in there), None)


def _colour_folder(path: Path) -> Path | None:
    inside = _first(path, COLOUR_FOLDERS)
    if inside is not None or _first(path, DEPTH_FOLDERS):
        return inside
    return path if any(p.suffix.lower() in COLOUR_SUFFIXES for p in path.iterdir()) else None


class _Truth(NamedTuple):
    """Each image's true pose, where from in words, what was read, and what is odd about it."""

    poses: list[Float64 | None]
    text: str
    read: list[Path]
    notes: list[str]


def _truth(path: Path, colour: list[Path]) -> _Truth:
    count, file, notes = len(colour), path / "traj.txt", []
    folder = _first(path, POSE_FOLDERS)
    if file.is_file():
        rows = read_matrices(file)
        if len(rows) != count:
            notes.append(
                f"traj.txt has {len(rows)} poses for {count} images; each image takes the line of its number"
            )
        poses, read = match_poses(colour, rows), file
    elif folder is not None:
        files = sorted(folder.glob("*.txt"))
        partners = pair_files(colour, files, "colour images", "poses").partners
        poses, read = read_matrix_files([files[i] if i >= 0 else None for i in partners]), folder
    else:
        return _Truth([None] * count, "", [], [])
    known = sum(pose is not None for pose in poses)
    name = read.name + "/" * (read != file)
    return _Truth(poses, f"{name}, poses of {known} of {count} frames, camera-to-world", [read], notes)


KIND = Kind(
    "folder", "color/, rgb/ or images/ and, if there, depth/; or images", recognises, open_sequence, True
)
