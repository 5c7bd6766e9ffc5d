# SPDX-License-Identifier: Apache-2.0
"""Pictures in ``sensor_msgs``: Image and CompressedImage, as colour or as depth, and CameraInfo."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError, FrameError
from ggwarp.datasets.formats.headers import PNG_SIGNATURE, check_size
from ggwarp.datasets.images import decode_colour, decode_depth, metres
from ggwarp.datasets.rig import Lens
from ggwarp.geometry.camera import Camera
from ggwarp.io.printable import printable, shown
from ggwarp.types import Float32

MILLIMETRES = 1000.0
_COLOUR = {
    "rgb8": (3, np.uint8, None),
    "bgr8": (3, np.uint8, cv2.COLOR_BGR2RGB),
    "rgba8": (4, np.uint8, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, np.uint8, cv2.COLOR_BGRA2RGB),
    "mono8": (1, np.uint8, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, np.uint8, cv2.COLOR_GRAY2RGB),
    "8UC3": (3, np.uint8, cv2.COLOR_BGR2RGB),
    "yuv422_yuy2": (2, np.uint8, cv2.COLOR_YUV2RGB_YUYV),
    "yuyv": (2, np.uint8, cv2.COLOR_YUV2RGB_YUYV),
    "yuv422": (2, np.uint8, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, np.uint8, cv2.COLOR_YUV2RGB_UYVY),
}
"""Encoding -> channels, their type, how OpenCV makes RGB of it."""
_DEPTH = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
_PLAIN = ("plumb_bob", "rational_polynomial", "")
_LENGTHS = (0, 4, 5, 8)


def is_depth(message: Any) -> bool | None:
    """Return whether a picture is depth; None: of a kind that is not read."""
    if hasattr(message, "format"):
        kind = str(message.format).lower()
        return "compresseddepth" in kind or "16uc1" in kind or "32fc1" in kind
    encoding = str(message.encoding)
    return True if encoding in _DEPTH else False if encoding in _COLOUR else None


def colour_of(message: Any, name: Path) -> NDArray[np.uint8]:
    """Return the colour picture [h, w, 3] RGB of a message; ``name`` is for errors.

    Raises:
        FrameError: it is damaged, or not colour.
    """
    if hasattr(message, "format"):
        return decode_colour(bytes(message.data), name)
    encoding = str(message.encoding)
    if encoding not in _COLOUR:
        raise FrameError(f"{name}: its encoding, {printable(encoding)[:40]}, is not read as colour")
    channels, dtype, conversion = _COLOUR[encoding]
    image = _pixels(message, channels, np.dtype(dtype), name)
    return np.ascontiguousarray(image if conversion is None else cv2.cvtColor(image, conversion), np.uint8)


def depth_of(message: Any, name: Path, scale: float = MILLIMETRES) -> Float32:
    """Return the depth picture [h, w] metres of a message.

    Args:
        scale: of whole numbers, raw / scale = metres.

    Raises:
        FrameError: it is damaged, or not depth.
    """
    if hasattr(message, "format"):
        data = bytes(message.data)
        at = data.find(PNG_SIGNATURE, 0, 64)  # behind the parameters of its quantisation, which are of no use
        if at < 0 or "32fc1" in str(message.format).lower():
            raise FrameError(
                f"{name}: compressed depth is read as PNG of 16UC1 alone; record it uncompressed"
            )
        return decode_depth(data[at:], name, scale=scale)
    encoding = str(message.encoding)
    if encoding not in _DEPTH:
        raise FrameError(f"{name}: its encoding, {printable(encoding)[:40]}, is not read as depth")
    dtype = np.dtype(_DEPTH[encoding]).newbyteorder(">" if message.is_bigendian else "<")
    raw = _pixels(message, 1, dtype, name)
    if raw.dtype.kind == "f":
        return metres(raw)
    depth = np.divide(raw, scale, dtype=np.float32)
    depth[raw == 65535] = 0.0
    return depth


def _pixels(message: Any, channels: int, dtype: np.dtype, name: Path) -> NDArray[Any]:
    width, height, step = int(message.width), int(message.height), int(message.step)
    check_size(width, height, name)
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, np.uint8)
    if step < row or data.size < step * (height - 1) + row:
        raise FrameError(f"{name}: has {data.size:,} bytes for {width}x{height}; copy the bag again")
    rows = np.zeros(step * height, np.uint8)
    rows[: min(data.size, rows.size)] = data[: rows.size]
    pixels = np.ascontiguousarray(rows.reshape(height, step)[:, :row]).view(dtype)
    return (
        pixels.reshape(height, width, channels)[..., 0]
        if channels == 1
        else pixels.reshape(height, width, -1)
    )


def lens_of(info: Any, name: str) -> Lens:
    """Return the camera and distortion of a CameraInfo.

    Raises:
        DatasetError: its lens is not read, or it is not calibrated.
    """
    K = np.asarray(getattr(info, "K", None) if hasattr(info, "K") else info.k, np.float64).ravel()
    D = np.asarray(getattr(info, "D", None) if hasattr(info, "D") else info.d, np.float64).ravel()
    model = str(info.distortion_model)
    if len(K) != 9 or not np.isfinite(K).all() or K[0] <= 0.0 or K[4] <= 0.0:
        raise DatasetError(
            f"{name}: is not calibrated (K is {shown(K.tolist())}); give --intrinsics? record it anew"
        )
    bent = bool(np.isfinite(D).all() and D.any())
    # RealSense names the model of a lens that it has straightened already, with zeros.
    if bent and (model not in _PLAIN or len(D) not in _LENGTHS) and "Brown" not in model:
        raise DatasetError(
            f"{name}: its lens, {printable(model)[:40]} of {len(D)}, is not read; rectify the pictures"
        )
    camera = Camera(int(info.width), int(info.height), K[0], K[4], K[2], K[5])
    return Lens(camera, tuple(D.tolist()) if bent else ())
