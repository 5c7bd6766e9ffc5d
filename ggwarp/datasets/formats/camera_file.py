# SPDX-License-Identifier: Apache-2.0
"""What is written in a camera file: JSON of several spellings, one line of numbers, or a matrix."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.text import read_numbers
from ggwarp.io import guarded
from ggwarp.io.printable import printable, shown

JSON_EXAMPLE = '{"w": 640, "h": 480, "fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5, "scale": 1000}'

_SPELLINGS = {
    "w": "width",
    "h": "height",
    "scale": "depth_scale",
    "png_depth_scale": "depth_scale",
    "depth_factor": "depth_scale",
    "depth_map_factor": "depth_scale",
    "DepthMapFactor": "depth_scale",
    "dist_coeffs": "distortion",
    "distortion_coefficients": "distortion",
    "D": "distortion",
    "fl_x": "fx",
    "fl_y": "fy",
}
"""Spellings of other programs -> the full name."""
_MATRICES = ("intrinsic_matrix", "K", "camera_matrix", "intrinsics")
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_MEANT = re.compile(r"(?i)dist|^[kp]\d$|scale|unit|factor|crop|offset|shift|skew")
_READ = {*_SPELLINGS, *_SPELLINGS.values(), *_COEFFICIENTS, "depth_distorted", "distortion_model"}
_MODEL_KEYS = ("camera_model", "distortion_model", "lens_model", "model", "camera_type", "projection")
_PINHOLES = frozenset(
    {
        "PINHOLE",
        "OPENCV",
        "RADTAN",
        "PLUMB_BOB",
        "BROWN_CONRADY",
        "RATIONAL_POLYNOMIAL",
        "PERSPECTIVE",
        "NONE",
    }
)
_OTHER_LENSES = ("FISHEYE", "EQUIDISTANT", "KANNALA", "OMNI", "THETA", "MEI", "EUCM", "SPHER", "EQUIRECT")


def camera_values(path: Path) -> dict[str, Any]:
    """Return what a camera file says, by full names; ``notes`` is a list of what is odd about it.

    Raises:
        DatasetError: it cannot be read, or is of no form that is known.
    """
    return _read_json(path) if path.suffix == ".json" else _read_table(path)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = guarded.read_json(path, guarded.CAMERA)
    except guarded.FileError as error:
        raise DatasetError(str(error)) from error
    values = found
    if isinstance(found, dict) and isinstance(found.get("camera"), dict):
        # What stands beside "camera" counts, too: a depth scale above all.
        values = {key: value for key, value in found.items() if key != "camera"} | found["camera"]
    if not isinstance(values, dict):
        raise DatasetError(f"{path}: is not a JSON object; expected such as {JSON_EXAMPLE}")
    return in_full(values, path)


def in_full(values: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a camera file's values with every key by its full name."""
    values.pop("notes", None)
    for short, full in _SPELLINGS.items():
        if short in values:
            values[full] = values[short]
    if "distortion" not in values and any(values.get(key) for key in _COEFFICIENTS):
        last = max(i for i, key in enumerate(_COEFFICIENTS) if values.get(key))
        count = next(n for n in (4, 5, 8) if n > last)
        values["distortion"] = [values.get(key) or 0.0 for key in _COEFFICIENTS[:count]]
    matrix = next((values[key] for key in _MATRICES if key in values), None)
    flat = not (isinstance(matrix, list) and len(matrix) == 3)
    if isinstance(matrix, list) and len(matrix) == 3 and all(isinstance(row, list) for row in matrix):
        matrix = [value for row in matrix for value in row]
    if isinstance(matrix, list) and len(matrix) == 9:
        values.update(_from_matrix(matrix, path, columns=flat))
    unread = [key for key in values if _MEANT.search(key) and key not in _READ]
    if unread:
        note = f"{path.name}: {', '.join(map(printable, unread[:4]))}: such keys are not read"
        values["notes"] = [*values.get("notes", ()), note]
    return values


def _read_table(path: Path) -> dict[str, Any]:
    rows = [values for _, values in read_numbers(path)]
    if len(rows) == 1 and len(rows[0]) == 9 and _is_matrix(rows[0]):
        rows = [rows[0][0:3], rows[0][3:6], rows[0][6:9]]
    if len(rows) == 1 and len(rows[0]) in (4, 8, 9):
        fx, fy, cx, cy, *distortion = rows[0]
        return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": distortion}
    if len(rows) in (3, 4) and {len(row) for row in rows} in ({len(rows)}, {4}):
        return _from_matrix([value for row in rows[:3] for value in row[:3]], path, columns=False)
    raise DatasetError(
        f"{path}: expected one line 'fx fy cx cy [k1 k2 p1 p2 k3]' or a 3x3 matrix, found {len(rows)} lines"
    )


def _is_matrix(values: list[float]) -> bool:
    """Return whether nine numbers are a camera's matrix, by rows or columns: of zeros where it has them."""
    zeros = (values[1], values[3])
    return not any(zeros) and values[8] == 1.0 and (values[2:6:3] == [0, 0] or values[6:8] == [0, 0])


def _from_matrix(values: list[Any], path: Path, *, columns: bool) -> dict[str, Any]:
    """Return fx, fy, cx, cy of nine numbers; where the centre stands tells whether by rows or by columns.

    Args:
        columns: how the format has them, of which the other order is noted.
    """
    by_rows = values[6] == 0 and values[7] == 0
    by_columns = values[2] == 0 and values[5] == 0
    found_columns = columns if by_rows == by_columns else by_columns
    order = (0, 4, 6, 7) if found_columns else (0, 4, 2, 5)
    camera: dict[str, Any] = dict(zip(("fx", "fy", "cx", "cy"), (values[i] for i in order), strict=True))
    if found_columns != columns:
        written = "columns" if found_columns else "rows"
        camera["notes"] = [f"{path.name}: its matrix is written by {written}, and is read so"]
    return camera


def lens_notes(values: dict[str, Any], path: Path) -> list[str]:
    """Return a note for a lens model that is not known, having taken the models out of ``values``.

    Raises:
        DatasetError: it is another lens than a pinhole with OpenCV's radial and tangential distortion.
    """
    notes = []
    for key in _MODEL_KEYS:
        model = values.pop(key, None)
        if not isinstance(model, str) or model.replace("-", "_").replace(" ", "_").upper() in _PINHOLES:
            continue
        if any(name in model.upper() for name in _OTHER_LENSES):
            raise DatasetError(
                f"{path}: {key} {shown(model)} is not read; undistort the images to a pinhole camera"
            )
        notes.append(f"{path.name}: {key} {shown(model)} is not known, and taken for a pinhole camera's")
    return notes
