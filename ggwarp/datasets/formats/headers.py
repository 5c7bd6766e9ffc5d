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
_PNM = re.compile(rb"P[1-6](?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})\s")
_PNM_BYTES = 4096  # where its size must have been told


def size_in_header(data: bytes, path: Path) -> tuple[int, int]:
    """Return the (width, height) that the image file ``data`` claims, without decoding it.

    Raises:
        FrameError: it is no PNG, JPEG, BMP or PNM image, or claims more pixels than any camera has.
    """
    size = _claimed_size(data)
    if size is None:
        raise FrameError(f"{path}: is not an image of a kind that is read (PNG, JPEG, BMP, PPM)")
    width, height = size
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise FrameError(
            f"{path}: claims to be {width}x{height}; at most {MAX_SIDE} pixels a side and "
            f"{MAX_PIXELS:,} in all are read"
        )
    return width, height


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
    if found := _PNM.match(data, 0, _PNM_BYTES):
        return int(found[1]), int(found[2])
    return None
