# SPDX-License-Identifier: Apache-2.0
"""A sequence of image files: what every kind of data set on disk is once its lists are read."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError, FrameError, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import COLOUR_SUFFIXES, Size, WrongSizeError, read_colour, read_depth
from ggwarp.datasets.masks import find_masks, find_true_masks
from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import camera_fault
from ggwarp.io.guarded import FileError, inside
from ggwarp.types import Float32, Float64, Frame


@dataclass(frozen=True)
class Entry:
    """The files and values of one frame.

    Attributes:
        rgb: the colour image.
        depth: the depth image; None where there is none.
        timestamp: seconds.
        T_wc: [4, 4] true camera-to-world pose, when known.
        depth_timestamp: seconds, when the depth was taken; None: together with the colour.
    """

    rgb: Path
    depth: Path | None
    timestamp: float
    T_wc: Float64 | None = None
    depth_timestamp: float | None = None


class FileSequence:
    """A :class:`ggwarp.datasets.base.Dataset` read from image files.

    Colour (and masks, drawn on colour) are undistorted where the calibration has a distortion;
    depth is not: see :mod:`ggwarp.datasets.readers.tum`.
    """

    def __init__(
        self,
        root: Path,
        kind: str,
        entries: Sequence[Entry],
        calibration: Calibration,
        *,
        masks: Masks = None,
    ) -> None:
        """Open the sequence.

        Raises:
            DatasetError: there is no frame, no frame is usable, or ``masks`` is wrong.
        """
        if not entries:
            raise DatasetError(f"{root}: the sequence is empty")
        self.name = root.resolve().name
        self.kind = kind
        self.camera: Camera = calibration.camera
        self._root = root
        self._entries = list(entries)
        self._scale = calibration.depth_scale
        self._calibration = calibration
        self.stems = [entry.rgb.stem for entry in entries]
        """Each frame's name, as its mask has it."""
        self._masks = find_masks(root, self.stems, masks)
        self._true_masks = find_true_masks(root, self.stems, self._masks)
        self.has_depth = any(entry.depth for entry in entries)
        self.has_masks = self._masks is not None
        self._probe()
        if fault := camera_fault(**dataclasses.asdict(self.camera)):
            raise DatasetError(f"{root}: its camera cannot be right: {fault}")

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self._entries):
            raise IndexError(index)
        entry = self._entries[index]
        size = width, height = self.camera.width, self.camera.height
        rgb = self._colour(entry, size)
        depth = self._depth(entry, size)
        mask = self._masks.read(index, width, height) if self._masks else None
        truth = self._true_masks.read(index, width, height) if self._true_masks else None
        if self._undistort:  # from here on: a picture has the size that the camera file claims
            rgb = self._undistort.colour(rgb)
            mask, truth = self._undistort.labels(mask), self._undistort.labels(truth)
            if depth is not None:
                depth = np.where(self._undistort.seen, depth, np.float32(0.0))
        return Frame(
            index,
            entry.timestamp,
            rgb,
            depth,
            mask,
            entry.T_wc,
            depth_timestamp=entry.depth_timestamp,
            true_mask=truth,
        )

    def _colour(self, entry: Entry, size: Size) -> NDArray[np.uint8]:
        try:
            return read_colour(self._inside(entry.rgb), size)
        except WrongSizeError as error:
            raise FrameError(
                f"{entry.rgb}: {error.found[0]}x{error.found[1]}, but the camera file says "
                f"{size[0]}x{size[1]}; correct the camera file, or export the image again"
            ) from None

    def _depth(self, entry: Entry, size: Size) -> Float32 | None:
        if not self.has_depth:
            return None
        if entry.depth is None:
            raise FrameError(f"{entry.rgb}: there is no depth image of this frame")
        try:
            return read_depth(self._inside(entry.depth), scale=self._scale, size=size)
        except WrongSizeError as error:
            raise FrameError(
                f"{entry.depth}: {error.found[0]}x{error.found[1]}, but the colour is {size[0]}x{size[1]}; "
                "export the depth registered to the colour camera"
            ) from None

    @cached_property
    def _undistort(self) -> _Undistortion | None:
        return _Undistortion(self._calibration) if self._calibration.distortion else None

    def _inside(self, path: Path) -> Path:
        try:
            return inside(self._root, path)
        except FileError as error:
            raise FrameError(str(error)) from error

    def _probe(self) -> None:
        """Fail now, not after a thousand warnings, when no frame can be used."""
        last = len(self) - 1
        first_error: FrameError | None = None
        for index in sorted({0, last // 2, last}):
            try:
                self[index]
                return
            except FrameError as error:
                first_error = first_error or error
        raise DatasetError(str(first_error))


class _Undistortion:
    """Resamples colour and labels to the pinhole camera of the same focal lengths and centre."""

    def __init__(self, calibration: Calibration) -> None:
        camera = calibration.camera
        K = camera.matrix
        coefficients = np.array(calibration.distortion)
        size = (camera.width, camera.height)
        self._u, self._v = cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
        self.seen = (
            (self._u >= 0.0)
            & (self._u <= camera.width - 1.0)
            & (self._v >= 0.0)
            & (self._v <= camera.height - 1.0)
        )
        """[h, w] where the undistorted picture has colour at all."""
        if not self.seen.any():
            shown = " ".join(f"{value:g}" for value in calibration.distortion)
            raise DatasetError(f"distortion {shown}: leaves nothing of the picture; correct the camera file")

    def colour(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.remap(rgb, self._u, self._v, cv2.INTER_LINEAR), np.uint8)

    def labels(self, mask: NDArray[np.int32] | None) -> NDArray[np.int32] | None:
        if mask is None:
            return None
        rows = np.rint(np.where(self.seen, self._v, 0.0)).astype(np.intp)
        columns = np.rint(np.where(self.seen, self._u, 0.0)).astype(np.intp)
        return np.where(self.seen, mask[rows, columns], 0)


def frame_number(path: Path) -> int | None:
    """Return the last whole number in a file's stem (``frame000012`` -> 12); None without one."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def image_files(folder: Path, prefix: str = "", suffixes: Sequence[str] = COLOUR_SUFFIXES) -> list[Path]:
    """Return ``folder``'s files of ``suffixes``, whose names start with ``prefix``, by number, then name."""
    files = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and path.name.startswith(prefix) and not path.name.startswith(".")
    ]

    def order(path: Path) -> tuple[list[int], str]:
        return [int(number) for number in re.findall(r"\d+", path.stem)], path.name

    return sorted(files, key=order)


def match_by_number(paths: Sequence[Path], others: Sequence[Path]) -> list[Path | None]:
    """Return, for each of ``paths``, the one of ``others`` with the same stem, else the same number."""
    by_stem = {other.stem: other for other in others}
    by_number = {number: other for other in others if (number := frame_number(other)) is not None}

    def match(path: Path) -> Path | None:
        number = frame_number(path)
        return by_stem.get(path.stem) or (None if number is None else by_number.get(number))

    return [match(path) for path in paths]


def match_poses(paths: Sequence[Path], poses: Sequence[Float64 | None]) -> list[Float64 | None]:
    """Return each image's pose out of a list of one a line.

    Line i belongs to the i-th image when there are as many; to image number i otherwise (a
    recording of which images were deleted), None where there is no such line.
    """
    if len(poses) == len(paths):
        return list(poses)
    numbers = [frame_number(path) for path in paths]
    return [poses[n] if n is not None and n < len(poses) else None for n in numbers]
