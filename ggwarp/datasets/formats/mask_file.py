# SPDX-License-Identifier: Apache-2.0
"""What a mask's file means: object ids in the forms that segmenters and viewers write.

- one channel, 8 or 16 bits: the value is the id (``object_mask/``);
- RGB-coded: id = R + 256 G + 65536 B (DEVA's long ids);
- grey in RGB: R = G = B in every pixel: the grey is the id, as where a viewer saved one channel as three;
- a palette image: the palette index is the id (DEVA's short ids).

0 = no object. The form is told by the file, not by its folder.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import FrameError
from ggwarp.datasets.formats.headers import PNG_SIGNATURE
from ggwarp.datasets.images import decode, png_chunks, read_bytes

Ids = NDArray[np.int32]
_PALETTE = 3  # PNG colour type


class Mask(NamedTuple):
    """A mask as its file has it.

    Attributes:
        ids: [h, w]; 0 = no object.
        form: of the file: "one channel", "RGB-coded", "grey in RGB" or "palette".
    """

    ids: Ids
    form: str


def read_mask(path: Path) -> Ids:
    """Return the object ids [h, w] of a mask file, in any of the forms; 0 = no object.

    Raises:
        FrameError: the file is missing, damaged or of none of the forms.
    """
    return read_mask_file(path).ids


def read_mask_file(path: Path) -> Mask:
    """Return a mask file's ids and its form.

    Raises:
        FrameError: as :func:`read_mask`.
    """
    data = read_bytes(path)
    palette = _without_palette(data, path)
    if palette is not None:
        grey, bits = palette
        # OpenCV spreads fewer bits over 0..255.
        ids = (decode(grey, path, cv2.IMREAD_UNCHANGED) // (255 // (2**bits - 1))).astype(np.int32)
        return Mask(ids, "palette")
    image = decode(data, path, cv2.IMREAD_UNCHANGED)
    if image.ndim == 2:
        if image.dtype.kind not in "ui":
            raise FrameError(f"{path}: holds {image.dtype}; ids are whole numbers")
        return Mask(image.astype(np.int32), "one channel")
    fault = f"{path}: {image.shape[2]} channels of {image.dtype}; RGB-coded ids are 8 bits a channel"
    if image.dtype.kind != "u" or image.shape[2] < 3:
        raise FrameError(fault)
    blue, green, red = (image[..., channel].astype(np.int32) for channel in range(3))
    if np.array_equal(red, green) and np.array_equal(red, blue):
        return Mask(red, "grey in RGB")
    if image.dtype != np.uint8:
        raise FrameError(fault)
    return Mask(red + 256 * green + 65536 * blue, "RGB-coded")


def write_mask(path: Path, ids: Ids) -> None:
    """Write object ids [h, w] as ``object_mask/`` has them; RGB-coded where 16 bits do not hold them.

    Raises:
        OSError: the file cannot be written.
        ValueError: an id is negative, or above 2^24 - 1.
    """
    largest = int(ids.max(initial=0))
    if ids.min(initial=0) < 0 or largest >= 1 << 24:
        raise ValueError(f"{path}: ids {ids.min()} to {largest}; a mask holds 0 to {(1 << 24) - 1}")
    if largest < 1 << 16:
        image = ids.astype(np.uint8 if largest < 1 << 8 else np.uint16)
    else:
        image = np.stack([ids >> 16, (ids >> 8) & 255, ids & 255], axis=2).astype(np.uint8)  # BGR
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def _without_palette(data: bytes, path: Path) -> tuple[bytes, int] | None:
    """Return a palette PNG as a grey one of the same indices, and its bits a pixel; else None.

    OpenCV turns a palette into colours, of which two indices may share one.
    """
    if not data.startswith(PNG_SIGNATURE):
        return None
    chunks = list(png_chunks(data, path))
    header = chunks[0][1]
    if len(header) != 13 or header[9] != _PALETTE or header[8] not in (1, 2, 4, 8):
        return None
    grey = bytearray(PNG_SIGNATURE)
    for kind, content in chunks:
        if kind == b"IHDR":
            content = header[:9] + b"\x00" + header[10:]
        elif kind not in (b"IDAT", b"IEND"):
            continue
        grey += struct.pack(">I", len(content)) + kind + content
        grey += struct.pack(">I", zlib.crc32(kind + content))
    return bytes(grey), header[8]
