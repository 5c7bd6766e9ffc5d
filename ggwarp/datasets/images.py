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
from ggwarp.datasets.formats.arrays import NPY_SIGNATURE, ZIP_SIGNATURE, read_exr, read_numpy
from ggwarp.datasets.formats.headers import EXR_SIGNATURE, PNG_SIGNATURE, size_in_header
from ggwarp.datasets.formats.jpeg import (
    JPEG_SIGNATURE,
    JpegError,
    check_markers,
    decode_jpeg,
    quarter_turns,
)
from ggwarp.io import guarded
from ggwarp.types import Float32

Size = tuple[int, int]
"""Width and height, pixels."""

COLOUR_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".pgm", ".tif", ".tiff")
DEPTH_SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".exr", ".npy", ".npz")
_NEAREST, _FARTHEST = 1e-3, 1e5
"""Metres; depth of less or more is rubbish."""
_ARKIT_SURE = 2
"""Of ARKit's confidences, low, medium and high: 0, 1 and 2."""
_NO_READING = 65535
"""A saturated 16-bit reading is none (Kinect recordings mark holes with it, too)."""


class WrongSizeError(FrameError):
    """An image has another size than it should.

    Attributes:
        found: its (width, height), pixels.
    """

    def __init__(self, path: Path, found: Size, wanted: Size) -> None:
        super().__init__(f"{path}: {shown_size(found)}, but {shown_size(wanted)} is needed")
        self.found = found


def read_bytes(path: Path, size: Size | None = None) -> bytes:
    """Return a whole image file, having checked its header, and that it is not cut short.

    Args:
        size: (width, height) that it should have, pixels; None: any.

    Raises:
        FrameError: the file is missing, no regular file, empty, truncated, of another size, or fails its
            checksums.
    """
    data = _file_bytes(path)
    found = size_in_header(data, path)
    if size is not None and found != size:
        raise WrongSizeError(path, found, size)
    check_whole(data, path)
    return data


def _file_bytes(path: Path) -> bytes:
    try:
        data = guarded.read_bytes(path, guarded.IMAGE)
    except guarded.FileError as error:
        raise FrameError(str(error)) from error
    if not data:
        raise FrameError(f"{path}: is empty; copy it again")
    return data


def check_whole(data: bytes, path: Path) -> None:
    """Check what of a PNG's or JPEG's wholeness shows without decoding it.

    Raises:
        FrameError: it is truncated, or fails its checksums.
    """
    if data.startswith(PNG_SIGNATURE):
        for _ in png_chunks(data, path):
            pass
    elif data.startswith(JPEG_SIGNATURE):
        try:
            check_markers(data)
        except JpegError as error:
            raise FrameError(f"{path}: {error} after {len(data)} bytes; copy it again") from error


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
    """Decode an image file's bytes, having checked that its header is sound.

    Args:
        flags: OpenCV's; a JPEG picture is grey or colour, and never turned.

    Raises:
        FrameError: it is damaged, or of a kind that cannot be read.
    """
    size_in_header(data, path)
    if data.startswith(JPEG_SIGNATURE):
        try:
            image = decode_jpeg(data)
        except JpegError as error:
            raise FrameError(f"{path}: {error}; copy it again") from error
        if image is not None:
            colour = image.ndim == 2 and flags & cv2.IMREAD_COLOR and flags >= 0
            return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if colour else image
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f"{path}: is not an image that OpenCV can read")
    return image


def read_colour(path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """Return the colour image [h, w, 3] uint8, RGB, of any depth of 8 or 16 bits, grey or with alpha.

    Args:
        size: (width, height) that it should have, pixels; None: any. A picture that has it only once turned
            by a quarter as its EXIF says is turned.

    Raises:
        FrameError: the file is missing, damaged, no image or of another size.
    """
    return decode_colour(_file_bytes(path), path, size)


def decode_colour(data: bytes, path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """Do what :func:`read_colour` does, of a file's bytes; ``path`` is for messages."""
    found = size_in_header(data, path)
    turns = 0
    if size is not None and found != size:
        turns = quarter_turns(data) if found == size[::-1] else 0
        if not turns:
            raise WrongSizeError(path, found, size)
    check_whole(data, path)
    # Depth and calibration follow the sensor's pixels, so the EXIF orientation must not.
    image = decode(data, path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if size_of(image) != found:
        raise FrameError(
            f"{path}: decodes to {shown_size(size_of(image))}, but claims to be {shown_size(found)}"
        )
    image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return np.ascontiguousarray(np.rot90(image, turns) if turns else image, np.uint8)


def read_depth(path: Path, *, scale: float, size: Size | None = None) -> Float32:
    """Return the depth image [h, w] float32, metres; 0 = no reading.

    Whole numbers are of 16 bits or more (PNG, PGM, TIFF, NumPy), in units of 1 / ``scale`` metres; 65535
    is no reading. Floating point (EXR, TIFF, NumPy) is metres, whatever ``scale``, and what is not finite is
    no reading.

    Args:
        scale: raw value / scale = metres.
        size: (width, height) that it should have, pixels; None: any.

    Raises:
        FrameError: the file is missing, damaged, of another size, or not one channel of such numbers.
    """
    return decode_depth(_file_bytes(path), path, scale=scale, size=size)


def decode_depth(data: bytes, path: Path, *, scale: float, size: Size | None = None) -> Float32:
    """Do what :func:`read_depth` does, of a file's bytes; EXR is read from ``path`` itself."""
    if data.startswith((NPY_SIGNATURE, ZIP_SIGNATURE)):
        raw = read_numpy(data, path)
        found = size_of(raw)
    else:
        found = size_in_header(data, path)
        if size is not None and found != size:
            raise WrongSizeError(path, found, size)
        check_whole(data, path)
        raw = read_exr(path) if data.startswith(EXR_SIGNATURE) else decode(data, path, cv2.IMREAD_UNCHANGED)
    if size_of(raw) != (size or found):
        raise WrongSizeError(path, size_of(raw), size or found)
    if raw.ndim == 2 and raw.dtype.kind == "f":
        return metres(raw)
    if raw.ndim != 2 or raw.dtype.kind not in "ui" or raw.dtype.itemsize < 2:
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise FrameError(
            f"{path}: {channels} channel(s) of {raw.dtype}; depth must be one channel of uint16, or of "
            "metres in floating point (export the raw depth, not its colouring)"
        )
    depth = np.divide(raw, scale, dtype=np.float32)
    depth[(raw < 0) | (raw == _NO_READING)] = 0.0
    return depth


def metres(raw: NDArray) -> Float32:
    """Return depth in metres [h, w] float32 where what no sensor measures, or is not finite, is 0."""
    with np.errstate(over="ignore"):
        depth = raw.astype(np.float32)
    depth[~((depth >= _NEAREST) & (depth <= _FARTHEST))] = 0.0
    return depth


def read_confidence(path: Path) -> NDArray[np.uint8]:
    """Return a depth image's confidence [h, w] uint8, as the file has it.

    Raises:
        FrameError: the file is missing, damaged, or not one channel of uint8.
    """
    image = decode(read_bytes(path), path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint8:
        raise FrameError(
            f"{path}: is of {image.dtype} with {image.ndim} axes; confidence is one channel of uint8"
        )
    return image


def weighted(depth: Float32, confidence: NDArray[np.uint8]) -> tuple[Float32, Float32 | None]:
    """Return depth [h, w] without the readings of no confidence, and what the others count [h, w] float32.

    A reading counts in proportion to its confidence, 0 to 2 (ARKit's) or 0 to 255, as its variance is the
    inverse; None in the weights' place: all count fully.
    """
    top = np.float32(_ARKIT_SURE if confidence.max(initial=0) <= _ARKIT_SURE else 255)
    weights = (confidence / top).astype(np.float32)
    depth = np.where(weights > 0.0, depth, np.float32(0.0))
    return depth, weights if (weights[depth > 0.0] < 1.0).any() else None


def size_of(image: NDArray) -> Size:
    """Return the (width, height) of an image [h, w, ...]."""
    return image.shape[1], image.shape[0]


def shown_size(size: Size) -> str:
    """Return a size as messages have it: 640x480."""
    return f"{size[0]}x{size[1]}"


def image_size(paths: list[Path]) -> Size:
    """Return (width, height) of the first of ``paths`` that can be read.

    Raises:
        DatasetError: none can; says why of the first.
    """
    first: FrameError | None = None
    for path in paths:
        try:
            return size_of(read_colour(path))
        except FrameError as error:
            first = first or error
    raise DatasetError(str(first))
