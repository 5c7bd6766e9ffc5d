# SPDX-License-Identifier: Apache-2.0
"""Image files, checked: OpenCV reads a damaged one as None or in part, without a word."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError, FrameError
from ggwarp.types import Float32

COLOUR_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".ppm")
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_END = b"\xff\xd9"
_NO_READING = 65535
"""A saturated 16-bit reading is none (Kinect recordings mark holes with it, too)."""


def read_bytes(path: Path) -> bytes:
    """Return a whole image file, having checked that it is not cut short.

    Raises:
        FrameError: the file is missing, empty, truncated or fails its checksums.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(f"{path}: cannot be read ({error.strerror})") from error
    if not data:
        raise FrameError(f"{path}: is empty; copy it again")
    if data.startswith(PNG_SIGNATURE):
        for _ in png_chunks(data, path):
            pass
    # Some cameras pad the file; a marker cannot occur inside the coded picture itself.
    elif data.startswith(b"\xff\xd8") and data.rfind(_JPEG_END, -4096) < 0:
        raise FrameError(f"{path}: is truncated after {len(data)} bytes; copy it again")
    return data


def png_chunks(data: bytes, path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield (type, content) of a PNG's chunks up to IEND, checksums verified.

    Raises:
        FrameError: the file is truncated or damaged.
    """
    at, kind = len(PNG_SIGNATURE), b""
    while kind != b"IEND":
        if at + 12 > len(data):
            raise FrameError(f"{path}: is truncated after {len(data)} bytes; copy it again")
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            raise FrameError(f"{path}: is truncated after {len(data)} bytes; copy it again")
        if zlib.crc32(data[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise FrameError(f"{path}: is damaged (a checksum does not match); copy it again")
        yield kind, data[at + 8 : end]
        at = end + 4


def decode(data: bytes, path: Path, flags: int) -> NDArray:
    """Decode an image file's bytes with OpenCV.

    Raises:
        FrameError: OpenCV cannot.
    """
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise FrameError(f"{path}: is not an image that OpenCV can read")
    return image


def read_colour(path: Path) -> NDArray[np.uint8]:
    """Return the colour image [h, w, 3] uint8, RGB.

    Raises:
        FrameError: the file is missing, damaged or no image.
    """
    # Depth and calibration follow the sensor's pixels, so the EXIF orientation must not.
    image = decode(read_bytes(path), path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth(path: Path, *, scale: float) -> Float32:
    """Return the depth image [h, w] float32, metres; 0 = no reading.

    Args:
        scale: raw value / scale = metres.

    Raises:
        FrameError: the file is missing, damaged, or not a one-channel 16-bit image.
    """
    raw = decode(read_bytes(path), path, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise FrameError(
            f"{path}: {channels} channel(s) of {raw.dtype}; depth must be one channel of uint16 "
            "(export the raw depth, not its colouring)"
        )
    depth = np.divide(raw, scale, dtype=np.float32)
    depth[raw == _NO_READING] = 0.0
    return depth


def image_size(paths: list[Path]) -> tuple[int, int]:
    """Return (width, height) of the first of ``paths`` that can be read.

    Raises:
        DatasetError: none can; says why of the first.
    """
    first: FrameError | None = None
    for path in paths:
        try:
            height, width = read_colour(path).shape[:2]
            return width, height
        except FrameError as error:
            first = first or error
    raise DatasetError(str(first))
