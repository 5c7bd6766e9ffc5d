# SPDX-License-Identifier: Apache-2.0
"""Whether a JPEG file is whole.

libjpeg fills what is missing with grey and prints a line to standard error, without the file's name. So
the markers are looked at here, and where a picture ends in that grey, the codes of its scan are counted.
Terms are those of ITU T.81: a scan holds the codes of minimum coded units (MCUs), each a few blocks of 8x8
values.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

JPEG_SIGNATURE = b"\xff\xd8"
_END = 0xD9
_START_OF_SCAN = 0xDA
_TABLES = 0xC4
_EXIF = 0xE1
_RESTARTS = range(0xD0, 0xD8)
_ALONE = {0x01, 0xD8, *_RESTARTS}  # markers without a content
_FRAMES = {*range(0xC0, 0xD0)} - {_TABLES, 0xC8, 0xCC}
_BASELINE = {0xC0, 0xC1}
_PROGRESSIVE = 0xC2

GREY = 128
"""What libjpeg makes of blocks that are not there, in every channel."""


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


def may_lack_data(image: NDArray) -> bool:
    """Return whether the decoded ``image`` [h, w] or [h, w, 3] ends as a picture does whose codes ran out."""
    return bool((image[-1, -1] == GREY).all())


def check_codes(data: bytes) -> None:
    """Check that the codes of a baseline picture last to its end; others are taken to be whole.

    Reads every code, a tenth of a second for a picture of a megapixel.

    Raises:
        JpegError: they run out, or one is no code.
    """
    tables: dict[int, list[int]] = {}
    frame = b""
    interval = 0
    for segment in _segments(data):
        content = segment.content
        if segment.marker in _FRAMES:
            if segment.marker not in _BASELINE or len(content) < 6 + 3 * content[5]:
                return
            frame = content
        elif segment.marker == _TABLES:
            tables |= _code_tables(content)
        elif segment.marker == 0xDD and len(content) >= 2:
            interval = int.from_bytes(content[:2], "big")
        elif segment.marker == _START_OF_SCAN and frame:
            _check_scan(data, segment, frame, tables, interval)


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


def _code_tables(content: bytes) -> dict[int, list[int]]:
    """Return class and number -> [65536] by the next 16 bits: 256 x length of code + symbol; 0 = no code."""
    found, at = {}, 0
    while at + 17 <= len(content):
        counts = content[at + 1 : at + 17]
        symbols = content[at + 17 : at + 17 + sum(counts)]
        table = np.zeros(1 << 16, np.int32)
        code, k = 0, 0
        for length, count in enumerate(counts, 1):
            width = 1 << (16 - length)
            for symbol in symbols[k : k + count]:
                table[code : code + width] = 256 * length + symbol
                code += width
            k += count
        found[content[at]] = table.tolist()
        at += 17 + sum(counts)
    return found


def _check_scan(
    data: bytes, scan: _Segment, frame: bytes, tables: dict[int, list[int]], interval: int
) -> None:
    height, width = (int.from_bytes(frame[i : i + 2], "big") for i in (1, 3))
    shapes = {frame[i]: (frame[i + 1] >> 4, frame[i + 1] & 15) for i in range(6, 6 + 3 * frame[5], 3)}
    count = scan.content[0]
    if len(scan.content) < 4 + 2 * count:
        raise JpegError("is damaged: the header of a scan is cut short")
    chosen = [(scan.content[1 + 2 * i], scan.content[2 + 2 * i]) for i in range(count)]
    try:
        selected = [(shapes[c], tables[t >> 4], tables[0x10 | t & 15]) for c, t in chosen]
        across, down = (max(shape[i] for shape in shapes.values()) for i in (0, 1))
        if count == 1:  # not interleaved: its own blocks, however they are sampled
            h, v = selected[0][0]
            columns, rows = -(-width * h // (8 * across)), -(-height * v // (8 * down))
            blocks = [selected[0][1:]]
        else:
            columns, rows = -(-width // (8 * across)), -(-height // (8 * down))
            blocks = [entry[1:] for entry in selected for _ in range(entry[0][0] * entry[0][1])]
    except (KeyError, ZeroDivisionError):
        raise JpegError("is damaged: a scan names what is not there") from None
    left = columns * rows
    for codes in _intervals(data, scan.end):
        units = min(left, interval or left)
        _check_interval(codes, blocks, units)
        left -= units
        if not left:
            return
    raise JpegError("is truncated: a part of the picture is missing")


def _intervals(data: bytes, start: int) -> Iterator[bytes]:
    """Yield the codes between restart markers from ``start`` on, without their stuffing."""
    at = begin = start
    while 0 <= (at := data.find(b"\xff", at)) < len(data) - 1:
        marker = data[at + 1]
        if marker == 0x00:
            at += 2
        elif marker == 0xFF:
            at += 1
        else:
            yield data[begin:at].replace(b"\xff\x00", b"\xff")
            if marker not in _RESTARTS:
                return
            at = begin = at + 2


def _check_interval(codes: bytes, blocks: list[tuple[list[int], list[int]]], units: int) -> None:
    """Walk the codes of ``units`` MCUs, each of ``blocks``: (table of first codes, table of the others)."""
    padded = np.frombuffer(codes + bytes(4), np.uint8).astype(np.int64)
    windows = ((padded[:-2] << 16) | (padded[1:-1] << 8) | padded[2:]).tolist()
    at, end = 0, 8 * len(codes)
    for _ in range(units):
        for first, others in blocks:
            if at >= end:
                raise JpegError("is truncated: its codes run out before the picture does")
            entry = first[windows[at >> 3] >> (8 - (at & 7)) & 0xFFFF]
            at += (entry >> 8) + (entry & 15)
            k = 1 if entry else 64
            while k < 64 and at < end:
                entry = others[windows[at >> 3] >> (8 - (at & 7)) & 0xFFFF]
                if not entry:
                    raise JpegError("is damaged: it holds what is no code")
                bits = entry & 15
                at += (entry >> 8) + bits
                k += (entry >> 4 & 15) + 1 if bits or entry & 0xF0 == 0xF0 else 64
    if at > end:
        raise JpegError("is truncated: its codes run out before the picture does")
