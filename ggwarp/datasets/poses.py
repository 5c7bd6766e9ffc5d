# SPDX-License-Identifier: Apache-2.0
"""Ground-truth poses from text files; a row that is no pose becomes None, with a warning."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.pairing import unit_name, unit_of_times
from ggwarp.datasets.text import read_numbers
from ggwarp.geometry import se3
from ggwarp.types import Float64

log = logging.getLogger(__name__)

_ROTATION_TOLERANCE = 1e-2
"""Largest entry of R^T R - I that the rounding of a text file may leave."""
_FARTHEST = 1e6
"""Metres from the world's origin; what is farther is no place of a camera."""
_LATEST = 1e12
"""Seconds; times are counted from 1970, or from when the recorder was switched on."""


def read_matrices(path: Path) -> list[Float64 | None]:
    """Read camera-to-world poses, one row-major 4x4 (or 3x4) matrix a line.

    Returns:
        One [4, 4] float64 pose a line, metres; None where the row is not finite or not a
        rigid motion (one warning says which lines).

    Raises:
        DatasetError: a line does not hold 12 or 16 numbers.
    """
    poses: list[Float64 | None] = []
    unusable = []
    for line, values in read_numbers(path):
        if len(values) not in (12, 16):
            raise DatasetError(
                f"{path}:{line}: {len(values)} numbers; a pose is a 4x4 matrix, 16 numbers a line"
            )
        pose = rigid(np.array(values).reshape(-1, 4))
        poses.append(pose)
        if pose is None:
            unusable.append(line)
    _warn(path, unusable)
    return poses


def read_matrix_files(paths: Sequence[Path | None]) -> list[Float64 | None]:
    """Read camera-to-world poses, a 4x4 matrix a file; None where there is no file or it holds no pose.

    One warning says in which files there is none.

    Raises:
        DatasetError: a file does not hold 12 or 16 numbers.
    """
    poses: list[Float64 | None] = []
    unusable = []
    for path in paths:
        pose = None
        if path is not None:
            values = [value for _, row in read_numbers(path) for value in row]
            if len(values) not in (12, 16):
                raise DatasetError(f"{path}: {len(values)} numbers; a pose is a 4x4 matrix, 16 numbers")
            pose = rigid(np.array(values).reshape(-1, 4))
            if pose is None:
                unusable.append(path)
        poses.append(pose)
    if unusable:
        names = ", ".join(path.name for path in unusable[:5]) + (", ..." if len(unusable) > 5 else "")
        log.warning(
            "%s: %d of its files hold no pose (%s): frames without truth",
            unusable[0].parent,
            len(unusable),
            names,
        )
    return poses


def read_stamped(path: Path) -> tuple[Float64, list[Float64 | None]]:
    """Read a TUM trajectory: ``t tx ty tz qx qy qz qw`` a line, camera-to-world.

    Times that are milliseconds, microseconds or nanoseconds since 1970 by their size are taken for these.

    Returns:
        [n] timestamps in seconds, and n poses [4, 4] or None as in :func:`read_matrices`.

    Raises:
        DatasetError: a line does not hold 8 numbers, or its time is not finite.
    """
    stamps: list[float] = []
    lines: list[int] = []
    poses: list[Float64 | None] = []
    unusable = []
    for line, values in read_numbers(path):
        if len(values) != 8:
            raise DatasetError(f"{path}:{line}: {len(values)} numbers; expected t tx ty tz qx qy qz qw")
        t, tx, ty, tz, qx, qy, qz, qw = values
        pose = pose_from_quaternion((tx, ty, tz), (qx, qy, qz, qw))
        if pose is None:
            unusable.append(line)
        stamps.append(t)
        lines.append(line)
        poses.append(pose)
    _warn(path, unusable)
    return in_seconds(stamps, path, lines)[0], poses


def read_numbered(path: Path) -> dict[int, Float64 | None]:
    """Read ``number tx ty tz qx qy qz qw`` a line, camera-to-world.

    Returns:
        Number of the frame -> its pose [4, 4], metres; None where the row holds none.

    Raises:
        DatasetError: a line does not hold 8 numbers, or the first is no frame's.
    """
    found: dict[int, Float64 | None] = {}
    for line, values in read_numbers(path):
        if len(values) != 8 or not 0 <= values[0] < 1e9 or values[0] != int(values[0]):
            raise DatasetError(f"{path}:{line}: expected a frame's number, tx ty tz qx qy qz qw")
        found[int(values[0])] = pose_from_quaternion(values[1:4], values[4:])
    return found


def in_seconds(times: Sequence[float], path: Path, lines: Sequence[int]) -> tuple[Float64, str]:
    """Return ``times`` of a list in seconds, and the name of the unit they are written in.

    Args:
        lines: where each stands in the file ``path``.

    Raises:
        DatasetError: one cannot be a time.
    """
    unit = unit_of_times(np.array(times)) or 1.0
    for line, time in zip(lines, times, strict=True):
        if not is_time(time / unit):
            raise DatasetError(f"{path}:{line}: {time:g} is not a time")
    return np.array(times) / unit if unit != 1.0 else np.array(times), unit_name(unit)


def pose_from_quaternion(position: Sequence[float], xyzw: Sequence[float]) -> Float64 | None:
    """Return the pose [4, 4] of a position and a quaternion, x y z w; None where they are none."""
    values = [*position, *xyzw]
    near = np.isfinite(values).all() and max(map(abs, values)) < _FARTHEST
    if not near or abs(np.linalg.norm(xyzw) - 1.0) >= _ROTATION_TOLERANCE:
        return None
    x, y, z, w = xyzw
    pose = np.eye(4)
    pose[:3, :3] = se3.matrix_from_quat([w, x, y, z])
    pose[:3, 3] = position
    return pose


def opencv_axes(pose: Float64 | None) -> Float64 | None:
    """Return a camera-to-world pose of a camera that looks along -z with y up (OpenGL, ARKit) in ours."""
    return None if pose is None else pose @ np.diag([1.0, -1.0, -1.0, 1.0])


def is_time(seconds: float) -> bool:
    """Return whether ``seconds`` can be when something was seen."""
    return abs(seconds) < _LATEST


def rigid(rows: Float64) -> Float64 | None:
    """Return the rigid motion [4, 4] of its first three or four rows; None where they are none."""
    T = np.eye(4)
    T[: len(rows)] = rows
    R = T[:3, :3]
    if not (np.abs(T) < _FARTHEST).all() or np.abs(R.T @ R - np.eye(3)).max() > _ROTATION_TOLERANCE:
        return None
    if np.linalg.det(R) < 0.0 or np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        return None
    return T


def _warn(path: Path, lines: list[int]) -> None:
    if lines:
        shown = ", ".join(map(str, lines[:5])) + (", ..." if len(lines) > 5 else "")
        log.warning(
            "%s: %d of its rows hold no pose (line %s): frames without truth", path, len(lines), shown
        )
