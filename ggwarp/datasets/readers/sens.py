# SPDX-License-Identifier: Apache-2.0
"""ScanNet's ``.sens`` files, version 4: a whole recording in one file.

Little-endian: u32 version, u64 and the sensor's name; 4x4 float32 by rows: intrinsics and extrinsics of
colour, then of depth; i32 compression of colour (0 raw, 1 PNG, 2 JPEG) and of depth (0 raw, 1 zlib); u32
width and height of both, float32 raw units a metre, u64 frames. A frame: camera-to-world 4x4 float32
(infinite where tracking was lost), u64 times of colour and depth in microseconds, u64 bytes of both, and
both.
"""

from __future__ import annotations

import struct
import zlib
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError, FrameError, Kind, Masks
from ggwarp.datasets.formats.headers import check_size
from ggwarp.datasets.images import Size, decode_colour
from ggwarp.datasets.poses import rigid
from ggwarp.datasets.readers.scannet import calibration
from ggwarp.datasets.sequence import Entry, FileSequence, Picture
from ggwarp.datasets.source import recorder_source
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.io import guarded
from ggwarp.io.camera import camera_fault
from ggwarp.types import Float32

_HEADER = struct.Struct("<16f16f16f16fiiIIIIfQ")
_FRAME = struct.Struct("<16fQQQQ")
_VERSION = 4
_LONGEST_NAME = 1024
_RAW, _ZLIB = 0, 1
_ENCODED = (1, 2)
_RATE = 30.0


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a recording, looking at the head of every frame.

    Raises:
        DatasetError: it is damaged, of another version, or compressed in a way that is not read.
    """
    try:
        with guarded.open_file(path, guarded.VIDEO) as file:
            return _open(path, file, guarded.check_file(path, guarded.VIDEO), masks)
    except guarded.FileError as error:
        raise DatasetError(str(error)) from error


def _open(path: Path, file: BinaryIO, length: int, masks: Masks) -> FileSequence:
    version, name = struct.unpack("<IQ", _exactly(file, 12, path))
    if version != _VERSION or name > _LONGEST_NAME:
        raise DatasetError(f"{path}: is no .sens file of version {_VERSION}; copy it again")
    _exactly(file, name, path)
    values = _HEADER.unpack(_exactly(file, _HEADER.size, path))
    matrices = [np.array(values[16 * i : 16 * i + 16]).reshape(4, 4) for i in range(4)]
    packing, depth_packing, width, height, depth_width, depth_height, shift, count = values[64:]
    if packing not in _ENCODED or depth_packing not in (_RAW, _ZLIB):
        raise DatasetError(
            f"{path}: its compression ({packing}, {depth_packing}) is not read; export it as images"
        )
    if not (np.isfinite(shift) and shift > 0.0):
        raise DatasetError(f"{path}: {shift:g} units a metre of depth cannot be; copy it again")
    camera = _camera(matrices[0], (width, height), path)
    depth_camera = _camera(matrices[2], (depth_width, depth_height), path)
    body = [rigid(matrices[1].astype(np.float64)), rigid(matrices[3].astype(np.float64))]
    T = None if body[0] is None or body[1] is None else se3.inverse(body[0]) @ body[1]
    entries: list[Entry] = []
    at = file.tell()
    while len(entries) < count:
        if at + _FRAME.size > length:
            break
        file.seek(at)
        head = _FRAME.unpack(_exactly(file, _FRAME.size, path))
        stamp, _, colour_bytes, depth_bytes = head[16:]
        at += _FRAME.size
        if max(colour_bytes, depth_bytes) > guarded.IMAGE.limit or at + colour_bytes + depth_bytes > length:
            break
        i = len(entries)
        rgb = partial(_colour, path, at, colour_bytes, i, (width, height))
        packed = (at + colour_bytes, depth_bytes, depth_packing == _ZLIB)
        depth = partial(_depth, path, packed, i, (depth_width, depth_height), shift)
        pose = rigid(np.array(head[:16], np.float64).reshape(4, 4))
        time = stamp / 1e6 if stamp else i / _RATE
        entries.append(Entry(Picture(path / f"{i}.jpg", rgb), Picture(path / f"{i}.png", depth), time, pose))
        at += colour_bytes + depth_bytes
    if not entries:
        raise DatasetError(f"{path}: is truncated before its first frame, or empty; copy it again")
    if len(entries) < count:  # what a copy that was cut short still holds is read
        entries.append(_lost(path, len(entries)))
    source = recorder_source(
        "ScanNet, .sens",
        entries,
        camera="its head",
        depth_unit=f"{shift:g} units a metre, from its head",
        truth="its frames, by BundleFusion",
    )
    found = calibration(camera, depth_camera, T, shift)
    return FileSequence(path, "sens", entries, found, masks=masks, source=source)


def _lost(path: Path, i: int) -> Entry:
    def read() -> NDArray[np.uint8]:
        raise FrameError(f"{path}: is truncated: frame {i} and all after it are missing; copy it again")

    picture = Picture(path / f"{i}.jpg", read)
    return Entry(picture, picture, i / _RATE)


def _camera(K: NDArray[np.floating], size: Size, path: Path) -> Camera:
    values = dict(width=size[0], height=size[1], fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])
    numbers = {key: float(value) for key, value in values.items()}
    fault = (
        camera_fault(**numbers)
        if np.isfinite(list(numbers.values())).all()
        else "its intrinsics are not finite"
    )
    if fault:
        raise DatasetError(f"{path}: its camera cannot be right: {fault}")
    return Camera(*size, *(numbers[key] for key in ("fx", "fy", "cx", "cy")))


def _exactly(file: BinaryIO, count: int, path: Path) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise DatasetError(f"{path}: is truncated; copy it again")
    return data


def _read_at(path: Path, at: int, count: int) -> bytes:
    try:
        with guarded.open_file(path, guarded.VIDEO) as file:
            file.seek(at)
            return file.read(count)
    except guarded.FileError as error:
        raise FrameError(str(error)) from error


def _colour(path: Path, at: int, count: int, i: int, size: Size) -> NDArray[np.uint8]:
    return decode_colour(_read_at(path, at, count), path / f"{i}.jpg", size)


def _depth(path: Path, packed: tuple[int, int, bool], i: int, size: Size, shift: float) -> Float32:
    at, count, compressed = packed
    name, wanted = path / f"{i}.png", 2 * size[0] * size[1]
    check_size(*size, name)
    data = _read_at(path, at, count)
    if compressed:
        try:
            data = zlib.decompressobj().decompress(data, wanted)
        except zlib.error as error:
            raise FrameError(f"{name}: is damaged ({error}); copy it again") from None
    if len(data) != wanted:
        raise FrameError(f"{name}: has {len(data):,} bytes of {wanted:,}; copy it again")
    raw = np.frombuffer(data, "<u2").reshape(size[1], size[0])
    return np.divide(np.where(raw == 65535, 0, raw), shift, dtype=np.float32)


KIND = Kind("sens", "ScanNet's .sens", lambda path: False, open_sequence, suffixes=(".sens",))
