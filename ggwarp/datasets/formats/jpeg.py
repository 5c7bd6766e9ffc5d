# SPDX-License-Identifier: Apache-2.0
"""JPEG files, and whether one is whole.

OpenCV decodes a damaged one in part, and its libjpeg prints a line to standard error, without the file's
name. simplejpeg has the same libjpeg-turbo, the same pixels, and says what is wrong. What libjpeg takes for
whole, a file without its end or a progressive picture without its last scans, shows in the markers. Damage
after which the codes fall into step again, and end where they should, shows nowhere. Terms are those of
ITU T.81.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import simplejpeg
from numpy.typing import NDArray

JPEG_SIGNATURE = b"\xff\xd8"
_END = 0xD9
_START_OF_SCAN = 0xDA
_TABLES = 0xC4
_EXIF = 0xE1
_RESTARTS = range(0xD0, 0xD8)
_ALONE = {0x01, 0xD8, *_RESTARTS}  # markers without a content
_FRAMES = {*range(0xC0, 0xD0)} - {_TABLES, 0xC8, 0xCC}
_PROGRESSIVE = 0xC2
_PADDING = re.compile(r"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")


class JpegError(ValueError):
    """The file is no whole JPEG: one clause that says why."""


@dataclass(frozen=True)
class _Segment:
    """A marker, its content, and for a scan where its codes begin."""

    marker: int
    content: bytes
    end: int


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return the (width, height) that the header of a JPEG claims; None where it has none."""
    try:
        for segment in _segments(data):
            if segment.marker in _FRAMES and len(segment.content) >= 6:
                height, width = (int.from_bytes(segment.content[i : i + 2], "big") for i in (1, 3))
                return width, height
    except JpegError:
        pass
    return None


def quarter_turns(data: bytes) -> int:
    """Return how many quarters, counter-clockwise, the EXIF orientation turns the picture: 1, 3, else 0."""
    try:
        for segment in _segments(data) if data.startswith(JPEG_SIGNATURE) else ():
            if segment.marker == _EXIF and segment.content.startswith(b"Exif\x00\x00"):
                return {6: 3, 8: 1}.get(_orientation(segment.content[6:]), 0)
            if segment.marker == _START_OF_SCAN:
                break
    except (JpegError, struct.error):
        pass
    return 0


def _orientation(tiff: bytes) -> int:
    """Return tag 274 of the first directory of an EXIF block; 1 where there is none."""
    order = "<" if tiff.startswith(b"II") else ">"
    (at,) = struct.unpack_from(order + "I", tiff, 4)
    (count,) = struct.unpack_from(order + "H", tiff, at)
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        if struct.unpack_from(order + "H", tiff, entry)[0] == 274:
            return struct.unpack_from(order + "H", tiff, entry + 8)[0]
    return 1


def check_markers(data: bytes) -> None:
    """Check what can be seen without decoding: the end marker, and that a progressive picture is complete.

    Raises:
        JpegError: the file ends early.
    """
    refined: dict[tuple[int, int], int] = {}  # (component, coefficient) -> bits that are still to come
    progressive, components, ended = False, 0, False
    for segment in _segments(data):
        content = segment.content
        if segment.marker in _FRAMES and len(content) >= 6:
            progressive, components = segment.marker == _PROGRESSIVE, content[5]
        elif segment.marker == _START_OF_SCAN and len(content) >= 4 + 2 * content[0]:
            first, last, bits = content[-3], min(content[-2], 63), content[-1] & 15
            for component in content[1 : 1 + 2 * content[0] : 2]:
                refined |= {(component, i): bits for i in range(first, last + 1)}
        ended = segment.marker == _END
    if not ended:
        raise JpegError("is truncated")
    if progressive and (any(refined.values()) or len({c for c, _ in refined}) < components):
        raise JpegError("is truncated: scans are missing")


def decode_jpeg(data: bytes) -> NDArray[np.uint8] | None:
    """Decode a whole JPEG file.

    Returns:
        [h, w] grey or [h, w, 3] blue, green, red; None: it is of a kind that only OpenCV may know.

    Raises:
        JpegError: it is damaged.
    """
    try:
        space = simplejpeg.decode_jpeg_header(data)[2]
    except ValueError:
        return None
    if space not in ("Gray", "YCbCr", "RGB"):
        return None
    wanted = "GRAY" if space == "Gray" else "BGR"
    try:
        image = simplejpeg.decode_jpeg(data, colorspace=wanted, strict=True)
    except ValueError as error:
        if not _is_harmless(str(error), data):
            raise JpegError(_fault(str(error))) from None
        try:
            image = simplejpeg.decode_jpeg(data, colorspace=wanted, strict=False)
        except ValueError as failure:
            raise JpegError(_fault(str(failure))) from None
    return image[..., 0] if wanted == "GRAY" else image


def _is_harmless(warning: str, data: bytes) -> bool:
    """Return whether libjpeg's ``warning`` is none of the picture: some cameras pad the codes of a frame."""
    if "JFIF" in warning or "Adobe" in warning:  # a version of their headers that is not known
        return True
    padding = _PADDING.fullmatch(warning)
    end = data.rfind(bytes([0xFF, _END]))
    return padding is not None and not data[max(0, end - int(padding[1])) : end].strip(b"\x00\xff")


def _fault(warning: str) -> str:
    """Return libjpeg's ``warning`` as a clause of our own."""
    if "premature end" in warning.lower():
        return "is truncated: its codes run out before the picture does"
    return f"is damaged ({warning.removeprefix('Corrupt JPEG data: ')})"


def _segments(data: bytes) -> Iterator[_Segment]:
    """Yield the segments of a file; what lies between them is skipped."""
    at = 2
    while 0 <= (at := data.find(b"\xff", at)) < len(data) - 1:
        marker = data[at + 1]
        if marker in (0x00, 0xFF) or marker in _ALONE:
            at += 1 if marker == 0xFF else 2
            continue
        if marker == _END:
            yield _Segment(marker, b"", at + 2)
            return
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        end = at + 2 + length
        if length < 2 or end > len(data):
            raise JpegError("is truncated")
        yield _Segment(marker, data[at + 4 : end], end)
        at = end
