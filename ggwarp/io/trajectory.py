# SPDX-License-Identifier: Apache-2.0
"""Trajectories in the TUM format: ``t tx ty tz qx qy qz qw`` a line, camera-to-world."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ggwarp.geometry import se3
from ggwarp.io.atomic import atomic_write
from ggwarp.io.guarded import TRAJECTORY, FileError, read_text
from ggwarp.io.printable import printable, shown
from ggwarp.types import Float64

_LARGEST = 1e12
"""Of a time in seconds, a position in metres, and a quaternion's numbers."""
_LEAST = 1e-6
"""Of a quaternion's largest number."""

_HEADER = "# timestamp tx ty tz qx qy qz qw (camera to world, metres)\n"


def write_tum(path: str | Path, timestamps: ArrayLike, poses: Sequence[Float64 | None]) -> None:
    """Write a trajectory; nothing is left half-written.

    Args:
        timestamps: [n] seconds.
        poses: n camera-to-world poses [4, 4], metres; None (unknown) ones are left out.

    Raises:
        OSError: the file cannot be written.
        ValueError: the lengths differ.
    """
    rows = [_HEADER]
    for stamp, T_wc in zip(np.asarray(timestamps, np.float64), poses, strict=True):
        if T_wc is None:
            continue
        qw, qx, qy, qz = se3.quat_from_matrix(T_wc[:3, :3])
        values = " ".join(f"{value:.9f}" for value in (*T_wc[:3, 3], qx, qy, qz, qw))
        rows.append(f"{stamp:.6f} {values}\n")
    with atomic_write(path) as file:
        file.write("".join(rows).encode())


def read_tum(path: str | Path) -> tuple[Float64, Float64]:
    """Read a trajectory.

    Returns:
        [n] timestamps, seconds, and [n, 4, 4] camera-to-world poses, metres.

    Raises:
        FileError: the file cannot be read, or a line (it is named) is not 8 finite numbers with a
            quaternion.
    """
    stamps, poses = [], []
    for number, line in enumerate(read_text(path, TRAJECTORY).splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        where = f"{printable(str(path))}:{number}: {shown(line.strip())}"
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            raise FileError(f"{where} is not a row of numbers") from None
        if len(values) != 8 or not (np.abs(values) < _LARGEST).all() or not np.abs(values[4:]).max() > _LEAST:
            raise FileError(f"{where} is no pose; expected t tx ty tz qx qy qz qw")
        T_wc = np.eye(4)
        T_wc[:3, :3] = se3.matrix_from_quat(values[[7, 4, 5, 6]])
        T_wc[:3, 3] = values[1:4]
        stamps.append(values[0])
        poses.append(T_wc)
    return np.array(stamps), np.array(poses).reshape(-1, 4, 4)
