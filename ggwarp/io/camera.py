# SPDX-License-Identifier: Apache-2.0
"""A run's camera as JSON: ``w h fx fy cx cy scale``, as in a recording's ``camera.json``."""

from __future__ import annotations

import json
from pathlib import Path

from ggwarp.geometry.camera import Camera
from ggwarp.io.atomic import atomic_write

DEPTH_SCALE = 1000.0
"""Of the depth pictures of a run: raw value / scale = metres."""

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
        OSError: the file cannot be read.
        ValueError: a value is missing, not a number, or the size or a focal length is not positive.
    """
    try:
        raw = json.loads(Path(path).read_text())
        values = {name: float(raw[key]) for key, name in _KEYS.items()}
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{path}: is no camera; {', '.join(_KEYS)} are needed as numbers") from None
    if min(values["width"], values["height"], values["fx"], values["fy"]) <= 0.0:
        raise ValueError(f"{path}: w, h, fx and fy must be positive")
    return Camera(
        int(values["width"]), int(values["height"]), *(values[name] for name in ("fx", "fy", "cx", "cy"))
    )
