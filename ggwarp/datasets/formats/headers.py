# SPDX-License-Identifier: Apache-2.0
"""What an image file says of itself before it is decoded: its format and its size."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from ggwarp.datasets.base import FrameError
from ggwarp.datasets.formats.jpeg import JPEG_SIGNATURE, jpeg_size
from ggwarp.io.camera import MAX_PIXELS, MAX_SIDE

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
EXR_SIGNATURE = b"v/1\x01"
TIFF_SIGNATURES = (b"II*\x00", b"MM\x00*")
_PNM = re.compile(rb"P[1-6](?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})\s")
_PNM_BYTES = 4096  # where its size must have been told
_EXR_BYTES = 1 << 16


def size_in_header(data: bytes, path: Path) -> tuple[int, int]:
    """Return the (width, height) that the image file ``data`` claims, without decoding it.

    Raises:
        FrameError: it is no PNG, JPEG, BMP, PNM, TIFF or EXR image, or claims more pixels than cameras have.
    """
    size = _claimed_size(data)
    if size is None:
        raise FrameError(f"{path}: is not an image of a kind that is read (PNG, JPEG, BMP, PPM, TIFF)")
    check_size(*size, path)
    return size


def check_size(width: int, height: int, path: Path) -> None:
    """Check that a camera can have taken a picture of ``width`` x ``height`` pixels.

    Raises:
        FrameError: none can.
    """
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise FrameError(
            f"{path}: claims to be {width}x{height}; at most {MAX_SIDE} pixels a side and "
            f"{MAX_PIXELS:,} in all are read"
        )


def _claimed_size(data: bytes) -> tuple[int, int] | None:
    if data.startswith(PNG_SIGNATURE):
        return struct.unpack_from(">II", data, 16) if len(data) >= 24 and data[12:16] == b"IHDR" else None
    if data.startswith(JPEG_SIGNATURE):
        return jpeg_size(data)
    if data.startswith(b"BM") and len(data) >= 26:
        if struct.unpack_from("<I", data, 14)[0] == 12:  # OS/2's header
            return struct.unpack_from("<HH", data, 18)
        width, height = struct.unpack_from("<ii", data, 18)
        return width, abs(height)
    if data.startswith(TIFF_SIGNATURES):
        return _tiff_size(data)
    if data.startswith(EXR_SIGNATURE):
        return _exr_size(data)
    if found := _PNM.match(data, 0, _PNM_BYTES):
        return int(found[1]), int(found[2])
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Return the size that the first directory of a TIFF claims (TIFF 6.0, section 2)."""
    order = "<" if data.startswith(b"II") else ">"
    sides: dict[int, int] = {}
    try:
        (at,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, at)
        for entry in range(at + 2, at + 2 + 12 * count, 12):
            tag, kind, number = struct.unpack_from(order + "HHI", data, entry)
            if tag in (256, 257) and kind in (3, 4) and number == 1:
                (sides[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, entry + 8)
    except struct.error:
        return None
    return (sides[256], sides[257]) if len(sides) == 2 else None


def _exr_size(data: bytes) -> tuple[int, int] | None:
    """Return the size of an OpenEXR file's data window; None for one of several parts or of deep pixels."""
    if len(data) < 8 or data[5] & 0x18:
        return None
    at, end = 8, min(len(data), _EXR_BYTES)
    try:
        while data[at] != 0:
            name_end = data.index(b"\x00", at, end)
            kind_end = data.index(b"\x00", name_end + 1, end)
            (length,) = struct.unpack_from("<i", data, kind_end + 1)
            if data[at:name_end] == b"dataWindow":
                left, top, right, bottom = struct.unpack_from("<4i", data, kind_end + 5)
                return right - left + 1, bottom - top + 1
            if length < 0:
                return None
            at = kind_end + 5 + length
    except (ValueError, IndexError, struct.error):
        pass
    return None
