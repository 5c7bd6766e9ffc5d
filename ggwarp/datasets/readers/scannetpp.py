# SPDX-License-Identifier: Apache-2.0
"""The iPhone part of ScanNet++: ``rgb.mkv`` or ``.mp4``, ``depth.bin`` and ``pose_intrinsic_imu.json``.

They lie in the scene's ``iphone/``. The JSON has ``frame_%06d``: ``timestamp``, ``intrinsic`` (3x3, of the
video's size) and ``aligned_pose`` or ``pose`` (camera-to-world, axes of OpenCV). ``depth.bin`` holds
pictures of 192x256 rows and columns: either all as float32 metres in one raw deflate stream, or each behind
its u32 length, as LZ4 of u16 millimetres or raw deflate of float32 metres.
"""

from __future__ import annotations

import struct
import zlib
from functools import partial
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError, FrameError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import metres
from ggwarp.datasets.poses import rigid
from ggwarp.datasets.readers.video import VideoFile
from ggwarp.datasets.rig import typical_camera
from ggwarp.datasets.sequence import Entry, FileSequence, Picture
from ggwarp.datasets.source import recorder_source
from ggwarp.datasets.text import numbers_of, read_json
from ggwarp.geometry.camera import Camera
from ggwarp.io import guarded
from ggwarp.io.camera import finite_number
from ggwarp.types import Float32

_ROWS, _COLUMNS = 192, 256
_METRES = 4 * _ROWS * _COLUMNS
_MILLIMETRES = 2 * _ROWS * _COLUMNS
_RATE = 60.0
_VIDEOS = ("rgb.mkv", "rgb.mp4")


def recognises(path: Path) -> bool:
    """Return whether ``path`` is a scene, or its iPhone part."""
    return any((folder / "pose_intrinsic_imu.json").is_file() for folder in (path, path / "iphone"))


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a scene.

    Raises:
        DatasetError: a file is missing, or malformed.
    """
    folder = path / "iphone" if (path / "iphone").is_dir() else path
    files = [folder / name for name in _VIDEOS if (folder / name).is_file()]
    if not files:
        raise DatasetError(f"{folder}: has no {' or '.join(_VIDEOS)}; copy it again")
    video = VideoFile(files[0], turned=False)
    depth = _Depth(folder / "depth.bin") if (folder / "depth.bin").is_file() else None
    entries = []
    for name, values in sorted(read_json(folder / "pose_intrinsic_imu.json").items()):
        number = name.removeprefix("frame_")
        K = numbers_of(values.get("intrinsic"), 9) if isinstance(values, dict) else None
        if K is None or not (number.isascii() and number.isdigit() and len(number) < 10):
            raise DatasetError(
                f"{folder / 'pose_intrinsic_imu.json'}: {name[:80]!r} has no intrinsic of nine numbers"
            )
        i = int(number)
        pose = numbers_of(values.get("aligned_pose", values.get("pose")), 16)
        stamp = finite_number(values.get("timestamp"))
        metric = None if depth is None else Picture(folder / f"depth.bin/{name}", partial(depth.read, i))
        entries.append(
            Entry(
                Picture(video.path / name, partial(video.read, i)),
                metric,
                i / _RATE if stamp is None else stamp,
                None if pose is None else rigid(np.array(pose).reshape(4, 4)),
                camera=Camera(*video.size, K[0], K[4], K[2], K[5]),
            )
        )
    if not entries:
        raise DatasetError(f"{folder}: the sequence is empty (pose_intrinsic_imu.json names no frame)")
    camera = typical_camera([entry.camera for entry in entries if entry.camera])
    source = recorder_source(
        "ScanNet++, an iPhone's rgb and depth.bin",
        entries,
        camera="pose_intrinsic_imu.json, frame by frame",
        depth_unit="metres or millimetres, as published",
        truth="pose_intrinsic_imu.json",
    )
    return FileSequence(path, "scannetpp", entries, Calibration(camera, 1000.0), masks=masks, source=source)


class _Depth:
    """The pictures of a ``depth.bin``; reading on is fast, going back only where they are framed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = Lock()
        self._places = self._framed()
        self._restart()

    def read(self, index: int) -> Float32:
        """Return picture ``index``, [192, 256] metres.

        Raises:
            FrameError: it is not there, or damaged.
        """
        with self._lock:
            try:
                raw = self._from_stream(index) if self._places is None else self._from_frame(index)
            except guarded.FileError as error:
                raise FrameError(str(error)) from error
            except zlib.error as error:
                raise self._damaged(index, str(error)) from None
        return metres(raw) if raw.dtype.kind == "f" else np.divide(raw, 1000.0, dtype=np.float32)

    def _damaged(self, index: int, reason: str) -> FrameError:
        return FrameError(f"{self._path}: frame {index} is damaged or missing ({reason}); copy it again")

    def _framed(self) -> list[tuple[int, int]] | None:
        """Return where each picture begins and its length; None where the lengths do not fill the file."""
        places = []
        try:
            end, at = guarded.check_file(self._path, guarded.VIDEO), 0
            with guarded.open_file(self._path, guarded.VIDEO) as file:
                while at + 4 <= end:
                    file.seek(at)
                    (length,) = struct.unpack("<I", file.read(4))
                    if not 0 < length <= 2 * _METRES:
                        return None
                    places.append((at + 4, length))
                    at += 4 + length
        except guarded.FileError as error:
            raise DatasetError(str(error)) from error
        return places if at == end and places else None

    def _from_frame(self, index: int) -> NDArray:
        if not self._places or index >= len(self._places):
            raise self._damaged(index, f"it holds {len(self._places or ())}")
        at, length = self._places[index]
        with guarded.open_file(self._path, guarded.VIDEO) as file:
            file.seek(at)
            data = file.read(length)
        try:
            plain = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, _METRES)
        except zlib.error:
            plain = b""
        if len(plain) == _METRES:
            return np.frombuffer(plain, "<f4").reshape(_ROWS, _COLUMNS)
        try:
            import lz4.block
        except ImportError:
            raise FrameError(f"{self._path}: is compressed with LZ4; pip install lz4") from None
        try:
            plain = lz4.block.decompress(data, uncompressed_size=_MILLIMETRES)
        except Exception as error:  # the library's own, of several types
            raise self._damaged(index, str(error)[:80]) from None
        if len(plain) != _MILLIMETRES:
            raise self._damaged(index, f"{len(plain)} bytes")
        return np.frombuffer(plain, "<u2").reshape(_ROWS, _COLUMNS)

    def _restart(self) -> None:
        self._next, self._at, self._waiting = 0, 0, b""
        self._inflating = zlib.decompressobj(-zlib.MAX_WBITS)

    def _from_stream(self, index: int) -> NDArray:
        if index < self._next:
            self._restart()
        with guarded.open_file(self._path, guarded.VIDEO) as file:
            file.seek(self._at)
            while True:
                plain = b""
                while len(plain) < _METRES:
                    packed = self._waiting or file.read(1 << 16)
                    piece = self._inflating.decompress(packed, _METRES - len(plain)) if packed else b""
                    self._waiting = self._inflating.unconsumed_tail
                    if not packed and not piece:
                        self._restart()
                        raise self._damaged(index, "the stream ends before it")
                    plain += piece
                self._at = file.tell()
                self._next += 1
                if self._next > index:
                    return np.frombuffer(plain, "<f4").reshape(_ROWS, _COLUMNS)


KIND = Kind("scannetpp", "ScanNet++: iphone/pose_intrinsic_imu.json", recognises, open_sequence)
