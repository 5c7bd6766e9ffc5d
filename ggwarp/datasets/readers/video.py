# SPDX-License-Identifier: Apache-2.0
"""A video file as a sequence of colour images, read with OpenCV."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError, FrameError
from ggwarp.datasets.calibration import Intrinsics, given_camera
from ggwarp.datasets.images import Size, size_of
from ggwarp.datasets.source import Source
from ggwarp.io.guarded import VIDEO, FileError, check_file
from ggwarp.types import Frame

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")

_RATE = 30.0


class VideoFile:
    """The pictures of a video, numbered as they are decoded; reading on is fast, going back opens it again.

    Attributes:
        rate: frames a second.
        size: (width, height), pixels.
    """

    def __init__(self, path: Path, *, turned: bool = True) -> None:
        """Open the file.

        Args:
            turned: pictures are turned as the file says; else they are the sensor's.

        Raises:
            DatasetError: OpenCV cannot read it.
        """
        self.path = path
        self._turned = turned
        self._lock = threading.Lock()
        self._capture, self._next = cv2.VideoCapture(), 0
        self._rewind()
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.rate = rate if 0.0 < rate < 1e4 else _RATE
        first = self._read()
        if first is None:
            raise self._unreadable()
        self.size: Size = size_of(first)

    def counted(self) -> int:
        """Return the number of pictures, having decoded all: the header's count is a guess."""
        with self._lock:
            while _decoded(self._capture.grab):
                self._next += 1
            count = self._next
            self._rewind()
        return count

    def read(self, index: int) -> NDArray[np.uint8]:
        """Return picture ``index``, [h, w, 3] RGB.

        Raises:
            FrameError: it cannot be decoded, or has another size than the first.
        """
        with self._lock:
            if index < self._next:
                self._rewind()
            while self._next < index and _decoded(self._capture.grab):
                self._next += 1
            rgb = self._read() if self._next == index else None
        if rgb is None:
            raise FrameError(f"{self.path}: frame {index} cannot be decoded")
        (width, height), first = size_of(rgb), self.size
        if (width, height) != first:
            raise FrameError(
                f"{self.path}: frame {index} is {width}x{height}, but the first one is {first[0]}x{first[1]}"
            )
        return rgb

    def _rewind(self) -> None:
        try:
            check_file(self.path, VIDEO)
        except FileError as error:
            raise DatasetError(str(error)) from error
        # An absolute path is never taken for an address, or for the pattern of a series of files.
        if not _decoded(lambda: self._capture.open(str(self.path.absolute()))):
            raise self._unreadable()
        if not self._turned:
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self._next = 0

    def _unreadable(self) -> DatasetError:
        return DatasetError(f"{self.path}: is not a video that OpenCV can read; convert it, such as to .mp4")

    def _read(self) -> NDArray[np.uint8] | None:
        good, image = _decoded(self._capture.read) or (False, None)
        self._next += 1
        if not good or image is None or image.ndim != 3:
            return None
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


class VideoSequence:
    """A :class:`ggwarp.datasets.base.Dataset` without depth, masks or poses."""

    kind = "video"
    has_depth = False
    has_masks = False
    source = Source(layout="a video", camera="--intrinsics")

    def __init__(self, path: Path, intrinsics: Intrinsics | None) -> None:
        """Open the file.

        Raises:
            DatasetError: OpenCV cannot read it, or its camera is not given.
        """
        self.name = path.stem
        self._video = VideoFile(path)
        self.camera = given_camera(path, self._video.size, intrinsics)
        self._count = self._video.counted()

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < self._count:
            raise IndexError(index)
        return Frame(index, index / self._video.rate, self._video.read(index))


def _decoded(call: Callable[[], Any]) -> Any:
    """Return what ``call`` of OpenCV returns; None where it fails."""
    try:
        return call()
    except cv2.error:
        return None
