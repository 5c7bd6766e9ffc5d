# SPDX-License-Identifier: Apache-2.0
"""Co-Fusion's rendered sequences, car4-full and room4-full, with the ids of their objects.

``colour/Color0001.png``, ``depth_noise/`` or ``depth_original/`` ``Depth0001.exr`` (metres),
``mask_id/Mask0001.png`` (grey in RGB, 0 = the background), ``calibration.txt`` (fx fy cx cy width height; the
centre is half the size, so that the first pixel's is at 0.5) and ``trajectories/gt-cam-0.txt``: number of the
frame, position, quaternion x y z w, camera-to-world. Objects move; theirs are the other trajectories.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ggwarp.datasets.base import DatasetError, Kind, MaskChoice, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import DEPTH_SUFFIXES, image_size
from ggwarp.datasets.pairing import frame_numbers, pair_files
from ggwarp.datasets.poses import read_numbered
from ggwarp.datasets.sequence import Entry, FileSequence, image_files
from ggwarp.datasets.source import Source, unread_entries
from ggwarp.datasets.text import read_numbers
from ggwarp.geometry.camera import Camera

_DEPTH = ("depth_noise", "depth_original")
_CAMERA, _POSES, _MASKS = "calibration.txt", Path("trajectories/gt-cam-0.txt"), "mask_id"
_RATE = 30.0


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a sequence in this layout."""
    return (path / "colour").is_dir() and any((path / name).is_dir() for name in _DEPTH)


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a sequence: with noisy depth where there is some, and its own masks where none are chosen.

    Raises:
        DatasetError: there are no images, a file is malformed, or names do not tell what belongs together.
    """
    colour = image_files(path / "colour")
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no images in colour/)")
    folder = next(path / name for name in _DEPTH if (path / name).is_dir())
    depth = image_files(folder, suffixes=DEPTH_SUFFIXES)
    pairing = pair_files(colour, depth, "colour images", "depth images")
    camera = _camera(path / _CAMERA, image_size(colour[:3]))
    poses = read_numbered(path / _POSES) if (path / _POSES).is_file() else {}
    entries = []
    for rgb, number, partner in zip(colour, frame_numbers(colour), pairing.partners, strict=True):
        stamp = (len(entries) if number is None else number) / _RATE
        T_wc = None if number is None else poses.get(number)
        entries.append(Entry(rgb, depth[partner] if partner >= 0 else None, stamp, T_wc))
    choice = MaskChoice.of(masks)
    if choice.where is None and (path / _MASKS).is_dir():
        choice = replace(choice, where=path / _MASKS)
    known = sum(entry.T_wc is not None for entry in entries)
    source = Source(
        layout=f"Co-Fusion's, colour/ and {folder.name}/",
        pairing=pairing.summary("colour images", "depth images"),
        camera=_CAMERA,
        truth=f"{_POSES}, poses of {known} of {len(entries)} frames" if known else "",
        notes=tuple(pairing.notes),
        unread=unread_entries(path, [path / n for n in ("colour", folder.name, _CAMERA, "trajectories")]),
    )
    return FileSequence(path, "co-fusion", entries, Calibration(camera, 1000.0), masks=choice, source=source)


def _camera(path: Path, size: tuple[int, int]) -> Camera:
    """Return the camera of images of (width, height) ``size``."""
    rows = [values for _, values in read_numbers(path)]
    if len(rows) != 1 or len(rows[0]) not in (4, 6):
        raise DatasetError(f"{path}: expected one line, fx fy cx cy width height")
    fx, fy, cx, cy, *told = rows[0]
    if told and tuple(told) != size:
        raise DatasetError(
            f"{path}: is of images of {told[0]:g}x{told[1]:g}, but these are {size[0]}x{size[1]}; correct it"
        )
    return Camera(*size, fx, fy, cx - 0.5, cy - 0.5)


KIND = Kind("co-fusion", "Co-Fusion: colour/, depth_noise/ and mask_id/", recognises, open_sequence)
