# SPDX-License-Identifier: Apache-2.0
"""Frames on standard input (``--seq -``), as any program can write them.

First a line of JSON: what a camera file has, ``w h fx fy cx cy``, and if need be ``scale``, ``distortion``,
``depth``, ``T_color_depth``; ``"has_depth": false`` where no depth follows. Then for each frame a line of
JSON, ``{"timestamp": 1.5, "color": 52713, "depth": 20114}``, and right behind it as many bytes: the colour
as a JPEG or PNG file, the depth as a 16-bit PNG, TIFF or .npy file. ``"T_wc"``, 16 numbers by rows, is a
true pose. The stream ends where it ends. Frames are read as they are used, so that none is lost and the
sender waits.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ggwarp.datasets.base import DatasetError, FrameError
from ggwarp.datasets.calibration import calibration_of
from ggwarp.datasets.formats.camera_file import JSON_EXAMPLE, in_full
from ggwarp.datasets.images import decode_colour, decode_depth
from ggwarp.datasets.live.sequence import LivePicture, LiveSequence
from ggwarp.datasets.poses import is_time, rigid
from ggwarp.datasets.text import numbers_of
from ggwarp.io import guarded
from ggwarp.io.camera import finite_number
from ggwarp.io.printable import shown

NAME = "standard input"
_LONGEST_LINE = 1 << 16
_RATE = 30.0
_MILLIMETRES = 1000.0


def open_stream(file: BinaryIO | None = None) -> LiveSequence:
    """Open a stream of frames; waits for its first line.

    Args:
        file: where it comes from; None: standard input.

    Raises:
        DatasetError: nothing is sent, or its first line describes no camera.
    """
    source = _standard_input() if file is None else file
    values = _line(source, "the first line")
    if values is None:
        raise DatasetError(f"{NAME}: is empty; expected a camera first, such as {JSON_EXAMPLE}")
    sides = [finite_number(values.get(key)) for key in ("w", "h")]
    if None in sides or min(side or 0 for side in sides) < 1:
        raise DatasetError(f"{NAME}: the first line lacks w and h; expected such as {JSON_EXAMPLE}")
    with_depth = values.pop("has_depth", True)
    if not isinstance(with_depth, bool):
        raise DatasetError(f"{NAME}: has_depth is {shown(with_depth)}; it must be true or false")
    size = int(sides[0] or 0), int(sides[1] or 0)
    path = Path(NAME)
    calibration = calibration_of(in_full(values, path), path, depth_scale=_MILLIMETRES, size=size)
    pictures = _pictures(source, calibration.depth_scale, with_depth)
    return LiveSequence(
        "stream", pictures, calibration, has_depth=with_depth, layout="frames on standard input"
    )


def _standard_input() -> BinaryIO:
    if sys.stdin is None or sys.stdin.isatty():
        raise DatasetError("--seq -: nothing is sent; pipe a sender into it, such as examples/send_frames.py")
    return sys.stdin.buffer


def _pictures(file: BinaryIO, scale: float, with_depth: bool) -> Iterator[LivePicture | FrameError]:
    """Yield what is sent; once it cannot be told where a frame begins, that is an error and the end."""
    i = 0
    while True:
        try:
            head = _line(file, f"the line of frame {i}")
            if head is None:
                return
            parts = [_part(file, head, key, i) for key in ("color", "depth")]
        except DatasetError as error:
            yield FrameError(f"{error}; nothing behind it can be read")
            return
        try:
            yield _picture(head, parts, scale, with_depth, i)
        except FrameError as error:
            yield error
        i += 1


def _picture(head: dict[str, Any], parts: list[bytes], scale: float, with_depth: bool, i: int) -> LivePicture:
    colour, depth = parts
    name = Path(NAME) / f"frame {i}"
    stamp = finite_number(head.get("timestamp"))
    if not colour:
        raise FrameError(f"{name}: has no color")
    pose = numbers_of(head.get("T_wc"), 16)
    return LivePicture(
        i / _RATE if stamp is None or not is_time(stamp) else stamp,
        decode_colour(colour, name / "color"),
        decode_depth(depth, name / "depth", scale=scale) if depth and with_depth else None,
        None if pose is None else rigid(np.array(pose).reshape(4, 4)),
    )


def _line(file: BinaryIO, what: str) -> dict[str, Any] | None:
    """Return the object that the next line holds; None: there is no more."""
    line = file.readline(_LONGEST_LINE + 1)
    if not line:
        return None
    try:
        values = json.loads(line) if len(line) <= _LONGEST_LINE else None
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise DatasetError(f"{NAME}: {what} is no JSON object: {shown(line[:60])}")
    return values


def _part(file: BinaryIO, head: dict[str, Any], key: str, i: int) -> bytes:
    count = finite_number(head.get(key, 0))
    if count is None or not 0 <= count <= guarded.IMAGE.limit or count != int(count):
        raise DatasetError(
            f"{NAME}: {key} of frame {i} is {shown(head.get(key))}; it must be a number of bytes"
        )
    data = b""
    while len(data) < count:
        piece = file.read(int(count) - len(data))
        if not piece:
            raise DatasetError(
                f"{NAME}: ends within frame {i}, after {len(data)} of {int(count)} bytes of {key}"
            )
        data += piece
    return data
