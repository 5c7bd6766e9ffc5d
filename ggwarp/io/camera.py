# SPDX-License-Identifier: Apache-2.0
"""A run's camera as JSON: ``w h fx fy cx cy scale``, as in a recording's ``camera.json``."""

from __future__ import annotations

import json
import math
from pathlib import Path

from ggwarp.geometry.camera import Camera
from ggwarp.io import guarded
from ggwarp.io.atomic import atomic_write
from ggwarp.io.printable import printable, shown

DEPTH_SCALE = 1000.0
"""Of the depth pictures of a run: raw value / scale = metres."""

MAX_SIDE = 16_384
"""Most pixels along an image's side."""
MAX_PIXELS = 1 << 26
"""Most pixels of an image: 64 megapixels."""
_FOCAL_RANGE = (0.1, 100.0)
"""Focal lengths that a camera may have, in widths of its image."""

_KEYS = {"w": "width", "h": "height", "fx": "fx", "fy": "fy", "cx": "cx", "cy": "cy"}


def write_camera(path: str | Path, camera: Camera) -> None:
    """Write ``camera``; ``scale`` is that of a run's depth pictures.

    Raises:
        OSError: the file cannot be written.
    """
    values = {key: getattr(camera, name) for key, name in _KEYS.items()} | {"scale": DEPTH_SCALE}
    with atomic_write(path) as file:
        file.write((json.dumps(values) + "\n").encode())


def read_camera(path: str | Path) -> Camera:
    """Read what :func:`write_camera` wrote.

    Raises:
        FileError: the file cannot be read, a value is missing or no number, or there is no such camera.
    """
    name = printable(str(path))
    raw = guarded.read_json(path, guarded.CAMERA)
    if not isinstance(raw, dict) or not set(_KEYS) <= set(raw):
        raise guarded.FileError(f"{name}: is no camera; {', '.join(_KEYS)} are needed as numbers")
    numbers = {key: finite_number(raw[key]) for key in _KEYS}
    for key, value in numbers.items():
        if value is None:
            raise guarded.FileError(f"{name}: {key} is {shown(raw[key])}; it must be a finite number")
    values = {full: value for key, full in _KEYS.items() if (value := numbers[key]) is not None}
    if fault := camera_fault(**values):
        raise guarded.FileError(f"{name}: {fault}")
    return Camera(
        int(values["width"]), int(values["height"]), *(values[name] for name in ("fx", "fy", "cx", "cy"))
    )


def finite_number(value: object) -> float | None:
    """Return the number that ``value`` is; None where it is something else, or no finite one."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def size_fault(*, width: float, height: float, **_: float) -> str | None:
    """Return why no image is of this size, pixels; None: there may be one."""
    for key, size in (("w", width), ("h", height)):
        if not 1 <= size <= MAX_SIDE or size != int(size):
            return f"{key} is {size:.6g}; it must be a whole number of pixels, 1 to {MAX_SIDE}"
    if width * height > MAX_PIXELS:
        return f"w x h is {width:g}x{height:g}; an image has at most {MAX_PIXELS:,} pixels"
    return None


def camera_fault(*, width: float, height: float, fx: float, fy: float, cx: float, cy: float) -> str | None:
    """Return why there is no camera of these values, all finite, in pixels; None: there may be one."""
    if fault := size_fault(width=width, height=height):
        return fault
    low, high = (share * width for share in _FOCAL_RANGE)
    for key, focal in (("fx", fx), ("fy", fy)):
        if focal <= 0.0:
            return f"{key} is {focal:g}; it must be positive"
        if not low <= focal <= high:
            return (
                f"{key} is {focal:g}; for images {width:g} pixels wide a focal length lies between "
                f"{low:g} and {high:g} pixels"
            )
    if not (0.0 <= cx < width and 0.0 <= cy < height):
        return f"its centre, cx {cx:g} and cy {cy:g}, lies outside the {width:g}x{height:g} images"
    return None
