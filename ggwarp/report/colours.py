# SPDX-License-Identifier: Apache-2.0
"""Pictures that people can read: depth and ids in colours, differences enlarged."""

from __future__ import annotations

import colorsys
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.distinct import ranked
from ggwarp.types import Float32

Picture = NDArray[np.uint8]
"""[h, w, 3] RGB."""

DIFFERENCE_GAIN = 4.0
"""How much a picture of differences enlarges them: white is a quarter of the range."""
_GOLDEN = 0.618034
"""Of the circle of hues, from an id to the next: neighbours differ, and none comes again soon."""
_PAINT = 0.65
"""Share of an object's colour in a picture of objects; the rest is the brightness of what is seen."""


def depth_in_colours(depth: Float32, limits: tuple[float, float]) -> Picture:
    """Return ``depth`` [h, w] metres from red (near) to blue (far) within ``limits``; black is none."""
    near, far = limits
    share = np.clip((far - depth) / max(far - near, 1e-6), 0.0, 1.0)
    coloured = cv2.applyColorMap(np.rint(255.0 * share).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where((depth > 0.0)[..., None], coloured, 0).astype(np.uint8)


def depth_limits(depth: Float32) -> tuple[float, float]:
    """Return the nearest and farthest depth, metres, but for a hundredth at either end."""
    readings = depth[depth > 0.0]
    if not len(readings):
        return 0.0, 1.0
    near, far = np.percentile(readings, (1.0, 99.0))
    return float(near), float(far)


def object_colour(identifier: int) -> tuple[int, int, int]:
    """Return the colour of an object, 0..255; grey for id 0."""
    if identifier == 0:
        return 128, 128, 128
    r, g, b = colorsys.hsv_to_rgb(identifier * _GOLDEN % 1.0, 0.75, 0.95)
    return round(255 * r), round(255 * g), round(255 * b)


def objects_in_colours(ids: NDArray[Any], rgb: Float32) -> Picture:
    """Return objects [h, w] in their colours over the brightness of ``rgb`` [h, w, 3] in 0..1."""
    known, rows = ranked(ids)
    paint = np.array([object_colour(int(i)) for i in known], np.float32)[rows] / 255.0
    grey = (rgb @ np.array([0.299, 0.587, 0.114], np.float32))[..., None]
    return to_bytes(_PAINT * paint + (1.0 - _PAINT) * grey)


def difference(rgb: Float32, frame: Picture) -> Picture:
    """Return how far ``rgb`` [h, w, 3] in 0..1 is from ``frame``, enlarged; black is equal."""
    return to_bytes(DIFFERENCE_GAIN * np.abs(rgb - frame.astype(np.float32) / 255.0))


def to_bytes(rgb: NDArray[Any]) -> Picture:
    """Return colours in 0..1 as bytes."""
    return np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)


def shrunk(picture: NDArray[Any], width: int, *, nearest: bool = False) -> NDArray[Any]:
    """Return ``picture`` no wider than ``width`` pixels."""
    if picture.shape[1] <= width:
        return picture
    size = (width, max(1, round(picture.shape[0] * width / picture.shape[1])))
    return np.asarray(
        cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA)
    )


def jpeg(picture: Picture, quality: int = 85) -> bytes:
    """Return ``picture`` as JPEG."""
    return cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
