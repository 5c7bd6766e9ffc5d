# SPDX-License-Identifier: Apache-2.0
"""Recordings of the Record3D app (iPhones and iPads with LiDAR or Face ID): .r3d files, exported folders.

An ``.r3d`` file is a ZIP archive of ``metadata`` and ``rgbd/N.jpg``, ``N.depth`` and ``N.conf``, the latter
two compressed with LZFSE. The export "EXR + RGB" is a folder of ``metadata.json``, ``rgb/N.jpg`` and
``depth/N.exr``. ``K`` is by columns and of the colour's size, poses are qx qy qz qw x y z, camera-to-world
with the axes of ARKit (y up, z back); depth is metres.
"""

from __future__ import annotations

import json
import re
import zipfile
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError, FrameError, Kind, Masks
from ggwarp.datasets.calibration import Calibration, has_camera_file
from ggwarp.datasets.formats.headers import check_size, size_in_header
from ggwarp.datasets.images import DEPTH_SUFFIXES, Size, decode_colour, image_size, metres
from ggwarp.datasets.poses import opencv_axes, pose_from_quaternion
from ggwarp.datasets.rig import typical_camera
from ggwarp.datasets.sequence import Entry, FileSequence, Picture, image_files
from ggwarp.datasets.source import recorder_source, whole_numbers
from ggwarp.datasets.text import numbers_of, read_json
from ggwarp.geometry.camera import Camera
from ggwarp.io import guarded
from ggwarp.io.camera import finite_number
from ggwarp.io.printable import printable
from ggwarp.types import Float32, Float64

_RATE = 60.0
_LARGEST_PACKED = 2 << 20
"""Bytes of compressed depth; of the largest, not compressed at all, there are 1.2 million."""
_DEPTH_SIZES = ((192, 256), (256, 192), (480, 640), (640, 480))
"""(width, height) of LiDAR's and Face ID's depth, upright and lying, where the recording does not say."""


def recognises(path: Path) -> bool:
    """Return whether ``path`` is an exported recording, or an .r3d file taken apart."""
    exported = (path / "metadata.json").is_file() and (path / "rgb").is_dir() and not has_camera_file(path)
    return exported or ((path / "metadata").is_file() and (path / "rgbd").is_dir())


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a recording.

    Raises:
        DatasetError: a part is missing or malformed, or LZFSE is not installed.
    """
    if path.is_file():
        return _packed(path, _Archive(path), masks)
    if (path / "rgbd").is_dir():
        return _packed(path, _Folder(path), masks)
    told = _Metadata(path / "metadata.json", read_json(path / "metadata.json"))
    colour = image_files(path / "rgb")
    depth = image_files(path / "depth", suffixes=DEPTH_SUFFIXES) if (path / "depth").is_dir() else []
    if not colour:
        raise DatasetError(f"{path}: the sequence is empty (no images in rgb/)")
    camera = told.camera(image_size(colour[:3]))
    metric, numbered = whole_numbers(depth), sorted(whole_numbers(colour).items())
    if not numbered:
        raise DatasetError(f"{path}: the images in rgb/ are not numbered; export it again")
    entries = [told.entry(i, rgb, metric.get(i), None) for i, rgb in numbered]
    return _sequence(path, entries, camera, masks, "Record3D's export, rgb/ and depth/")


def _sequence(path: Path, entries: list[Entry], camera: Camera, masks: Masks, layout: str) -> FileSequence:
    source = recorder_source(
        layout,
        entries,
        camera="its metadata",
        depth_unit="metres, as the app writes",
        truth="its metadata, by ARKit",
    )
    return FileSequence(path, "record3d", entries, Calibration(camera, 1000.0), masks=masks, source=source)


class _Metadata:
    """What ``metadata`` tells, checked."""

    def __init__(self, path: Path, values: Any) -> None:
        if not isinstance(values, dict) or not isinstance(values.get("K"), list):
            raise DatasetError(f"{path}: has no K; it is not the metadata of a Record3D recording")
        self.path, self.values = path, values
        K = numbers_of(values["K"], 9)
        if K is None:
            raise DatasetError(f"{path}: K is not nine numbers")
        self.K = K
        rate = finite_number(values.get("fps"))
        self.rate = rate if rate and 0.0 < rate < 1e4 else _RATE
        self.poses: list[Any] = values["poses"] if isinstance(values.get("poses"), list) else []
        stamps = values.get("frameTimestamps")
        self.stamps: list[Any] = stamps if isinstance(stamps, list) else []

    def camera(self, size: Size, K: list[float] | None = None) -> Camera:
        """Return the camera of colour pictures of ``size``; K is of the size that the metadata names."""
        fx, fy, cx, cy = ((K or self.K)[i] for i in (0, 4, 6, 7))
        told = [finite_number(self.values.get(key)) for key in ("w", "h")]
        width, height = (int(told[i] or size[i]) for i in (0, 1))
        camera = Camera(width, height, fx, fy, cx, cy)
        return camera if (width, height) == size else camera.resized(*size)

    def depth_size(self, count: int) -> Size | None:
        """Return the (width, height) of depth of ``count`` pixels; None: it cannot be told."""
        told = tuple(finite_number(self.values.get(key)) for key in ("dw", "dh"))
        sizes = [(int(told[0]), int(told[1]))] if told[0] and told[1] else []
        upright = (finite_number(self.values.get("h")) or 0) > (finite_number(self.values.get("w")) or 0)
        sizes += [size for size in _DEPTH_SIZES if (size[1] > size[0]) == upright]
        return next((size for size in sizes if size[0] * size[1] == count), None)

    def entry(self, i: int, rgb: Any, depth: Any, confidence: Any, camera: Camera | None = None) -> Entry:
        """Return frame ``i`` of these pictures."""
        stamp = finite_number(self.stamps[i]) if i < len(self.stamps) else None
        return Entry(
            rgb,
            depth,
            i / self.rate if stamp is None else stamp,
            self._pose(i),
            camera=camera,
            confidence=confidence,
        )

    def _pose(self, i: int) -> Float64 | None:
        values = self.poses[i] if i < len(self.poses) else None
        numbers = numbers_of(values, 7)
        if numbers is None:
            return None
        qx, qy, qz, qw, x, y, z = numbers
        return opencv_axes(pose_from_quaternion((x, y, z), (qx, qy, qz, qw)))


class _Archive:
    """The members of an .r3d file; several threads may read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = Lock()
        try:
            guarded.check_file(path, guarded.VIDEO)
            self._zip = zipfile.ZipFile(path)
        except guarded.FileError as error:
            raise DatasetError(str(error)) from error
        except Exception as error:  # zipfile raises a dozen types for damaged bytes
            reason = printable(str(error)) or type(error).__name__
            raise DatasetError(f"{path}: is no archive that can be read ({reason}); copy it again") from None
        self._members = {info.filename: info for info in self._zip.infolist()}

    def names(self) -> list[str]:
        return list(self._members)

    def read(self, name: str, limit: int) -> bytes:
        info = self._members.get(name)
        if info is None:
            raise FrameError(f"{self.path}: has no {name}; copy it again")
        if info.file_size > limit:
            raise FrameError(
                f"{self.path}: {name} claims {info.file_size:,} bytes, at most {limit:,} are read"
            )
        try:
            with self._lock, self._zip.open(info) as stream:
                return stream.read(limit)
        except Exception as error:
            reason = printable(str(error)) or type(error).__name__
            raise FrameError(f"{self.path}: {name} is damaged ({reason}); copy it again") from None


class _Folder:
    """The members of an .r3d file that has been taken apart."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def names(self) -> list[str]:
        return [f"rgbd/{file.name}" for file in (self.path / "rgbd").iterdir()]

    def read(self, name: str, limit: int) -> bytes:
        try:
            data = guarded.read_bytes(self.path / name, guarded.IMAGE)
        except guarded.FileError as error:
            raise FrameError(str(error)) from error
        if len(data) > limit:
            raise FrameError(f"{self.path / name}: has {len(data):,} bytes, at most {limit:,} are read")
        return data


def _packed(path: Path, members: _Archive | _Folder, masks: Masks) -> FileSequence:
    try:
        import lzfse  # noqa: F401
    except ImportError:
        raise DatasetError(f"{path}: its depth is compressed with LZFSE; pip install lzfse") from None
    try:
        text = members.read("metadata", guarded.LIST.limit)
        told = _Metadata(path / "metadata", json.loads(text))
    except FrameError as error:
        raise DatasetError(str(error)) from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path}: its metadata are not JSON; export it again from the app") from None
    found = {int(m[1]) for name in members.names() if (m := re.fullmatch(r"rgbd/(\d{1,9})\.jpg", name))}
    if not found:
        raise DatasetError(f"{path}: the sequence is empty (no rgbd/0.jpg)")
    depth = {int(m[1]) for name in members.names() if (m := re.fullmatch(r"rgbd/(\d{1,9})\.depth", name))}
    sure = {int(m[1]) for name in members.names() if (m := re.fullmatch(r"rgbd/(\d{1,9})\.conf", name))}
    first = members.read(f"rgbd/{min(found)}.jpg", guarded.IMAGE.limit)
    size = size_in_header(first, path / f"rgbd/{min(found)}.jpg")
    cameras = _cameras(told, size)
    camera = typical_camera(list(cameras.values())) if cameras else told.camera(size)
    entries = []
    for i in sorted(found):
        own = cameras.get(i)
        rgb = Picture(path / f"rgbd/{i}.jpg", partial(_colour, members, i, size))
        metric = Picture(path / f"rgbd/{i}.depth", partial(_depth, members, told, i)) if i in depth else None
        conf = Picture(path / f"rgbd/{i}.conf", partial(_confidence, members, told, i)) if i in sure else None
        entries.append(told.entry(i, rgb, metric, conf, own))
    return _sequence(path, entries, camera, masks, "Record3D, .r3d")


def _cameras(told: _Metadata, size: Size) -> dict[int, Camera]:
    """Return the cameras of single frames, where newer versions tell them: fx, fy, cx, cy."""
    rows = told.values.get("perFrameIntrinsicCoeffs")
    cameras = {}
    for i, row in enumerate(rows if isinstance(rows, list) else []):
        numbers = numbers_of(row, 4)
        if numbers and numbers[0] > 0.0 and numbers[1] > 0.0:
            fx, fy, cx, cy = numbers
            cameras[i] = told.camera(size, [fx, 0, 0, 0, fy, 0, cx, cy, 1])
    return cameras


def _colour(members: _Archive | _Folder, i: int, size: Size) -> NDArray[np.uint8]:
    path = members.path / f"rgbd/{i}.jpg"
    return decode_colour(members.read(f"rgbd/{i}.jpg", guarded.IMAGE.limit), path, size)


def _depth(members: _Archive | _Folder, told: _Metadata, i: int) -> Float32:
    return metres(_unpacked(members, told, f"rgbd/{i}.depth", np.dtype("<f4")))


def _confidence(members: _Archive | _Folder, told: _Metadata, i: int) -> NDArray[np.uint8]:
    return _unpacked(members, told, f"rgbd/{i}.conf", np.dtype(np.uint8))


def _unpacked(members: _Archive | _Folder, told: _Metadata, name: str, dtype: np.dtype) -> NDArray[Any]:
    import lzfse

    packed = members.read(name, _LARGEST_PACKED)
    path = members.path / name
    try:
        data = lzfse.decompress(packed)
    except Exception as error:
        reason = printable(str(error)) or type(error).__name__
        raise FrameError(f"{path}: is not compressed with LZFSE ({reason}); export it again") from None
    size = told.depth_size(len(data) // dtype.itemsize) if len(data) % dtype.itemsize == 0 else None
    if size is None:
        raise FrameError(f"{path}: has {len(data):,} bytes, which no size of depth explains; export it again")
    check_size(*size, path)
    return np.frombuffer(data, dtype).reshape(size[1], size[0])


KIND = Kind(
    "record3d",
    "Record3D: .r3d, or metadata.json, rgb/ and depth/",
    recognises,
    open_sequence,
    suffixes=(".r3d",),
)
