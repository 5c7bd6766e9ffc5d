# SPDX-License-Identifier: Apache-2.0
"""Frames read ahead by a thread, at the run's image scale."""

from __future__ import annotations

import contextlib
import copy
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import TypeVar

import cv2
import numpy as np

from ggwarp.datasets.base import Dataset, DatasetError, FrameError, SequenceEnd, at_scale, is_live
from ggwarp.datasets.resize import reduce_depth, resize_labels
from ggwarp.geometry.camera import Camera
from ggwarp.types import Frame

T = TypeVar("T")

_INTERVAL = 0.1
"""Seconds after which one who waits looks whether to go on."""

_PATIENCE = 5.0
"""Seconds that the frame being read may take to come, when no more are wanted."""


@dataclass(frozen=True)
class BadFrame:
    """A frame that cannot be used.

    Attributes:
        index: its index in the sequence.
        reason: one line that names the file and what is wrong.
    """

    index: int
    reason: str


_Item = Frame | BadFrame | BaseException | None
"""What the thread hands over; None: there are no more frames."""


class FrameReader:
    """Iterates over a sequence's frames; a thread reads and resamples them ahead.

    ::

        with FrameReader(dataset, range(len(dataset)), scale=0.5) as reader:
            for frame in reader:
                ...  # a Frame or a BadFrame
    """

    def __init__(
        self,
        dataset: Dataset,
        indices: Sequence[int],
        *,
        scale: float = 1.0,
        ahead: int = 4,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Prepare to read; the thread starts with the first iteration.

        Args:
            indices: frames to read, in this order.
            scale: image scale in (0, 1]: colour, depth and mask are resampled, and
                ``Frame.sensor_depth`` keeps the native depth where that is larger.
            ahead: frames held ready.
            stopped: asked while a frame is waited for, whether to end without it.

        Raises:
            DatasetError: ``scale`` is out of range.
        """
        if not 0.0 < scale <= 1.0:
            raise DatasetError(f"scale {scale:g}: the image scale lies above 0 and is at most 1")
        self.camera = dataset.camera.scaled(scale)
        """The camera of the frames handed out."""
        # Twice the size, then resampled: smooth edges at a fraction of the native size's cost.
        self._dataset = at_scale(dataset, min(1.0, 2.0 * scale))
        self.sensor_camera = self._dataset.camera
        """The camera of ``sensor_depth``: native size, or twice the frames' where they are rendered."""
        self.indices = indices if isinstance(indices, range) else list(indices)
        """The frames to read, in this order."""
        self._before: int | None = None  # the frame that went before the first
        self._ahead = ahead
        self._stopped = stopped
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def is_live(self) -> bool:
        """Whether frames come once, as they are taken."""
        return is_live(self._dataset)

    def after(self, count: int) -> FrameReader:
        """Return a reader of the frames after the first ``count``."""
        rest = copy.copy(self)
        rest.indices, rest._stop, rest._thread = self.indices[count:], threading.Event(), None
        gone = self.indices[:count]
        rest._before = gone[-1] if gone else self._before
        return rest

    def read(self, index: int) -> Frame:
        """Return frame ``index`` of the sequence as iteration hands it out, at once.

        Raises:
            FrameError: it cannot be used.
        """
        return resized(self._dataset[index], self.camera)

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop reading; frames not handed out yet are dropped.

        A disk that answers no more is not waited for: its thread ends with the program.
        """
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_INTERVAL if self._stopped() else _PATIENCE)

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        self.close()
        self._stop = threading.Event()
        ready: queue.Queue[_Item] = queue.Queue(self._ahead)
        self._thread = threading.Thread(
            target=self._read, args=(ready, self._stop), name="frame-reader", daemon=True
        )
        self._thread.start()
        for _ in self.indices:
            while not (items := _within(ready, _INTERVAL)):
                if self._stopped():
                    return
            item = items[0]
            if item is None:
                return
            if isinstance(item, BaseException):
                raise item
            yield item

    def _read(self, ready: queue.Queue[_Item], stop: threading.Event) -> None:
        last: Frame | None = None
        if self._before is not None and not self.is_live:
            with contextlib.suppress(FrameError):
                last = self._dataset[self._before]
        for index in self.indices:
            if stop.is_set():
                return
            try:
                frame = self._dataset[index]
                reason, last = repeated(frame, last), frame
                item = BadFrame(index, reason) if reason else resized(frame, self.camera)
            except FrameError as error:
                item = BadFrame(index, str(error))
            except SequenceEnd:
                item = None
            except BaseException as error:  # handed to the reader's user, who would else wait for ever
                item = error
            while not stop.is_set():
                try:
                    ready.put(item, timeout=_INTERVAL)
                    break
                except queue.Full:
                    continue
            if item is None or isinstance(item, BaseException):
                return


def _within(ready: queue.Queue[T], seconds: float) -> list[T]:
    """Return the next item; nothing where none comes in time."""
    try:
        return [ready.get(timeout=seconds)]
    except queue.Empty:
        return []


def repeated(frame: Frame, last: Frame | None) -> str:
    """Say which of a frame's pictures is the last frame's, to the bit, while the other is new; empty: none.

    A sensor's noise makes every picture another one; a recorder that missed one writes the last one again.
    """
    if last is None or frame.depth is None or last.depth is None or not frame.depth.any():
        return ""
    same_depth, same_picture = np.array_equal(frame.depth, last.depth), np.array_equal(frame.rgb, last.rgb)
    if same_depth == same_picture or np.ptp(frame.depth) == 0.0 or np.ptp(frame.rgb) == 0:
        return ""
    again, new = ("depth", "picture") if same_depth else ("picture", "depth")
    return f"the {again} of frame {last.index} is there again, beside a new {new}: one {again} was missed"


def resized(frame: Frame, camera: Camera) -> Frame:
    """Return ``frame`` resampled to ``camera``'s size.

    ``sensor_depth`` and ``native_mask`` keep what was there; the true mask stays at its own size, where
    objects are measured.
    """
    if frame.rgb.shape[:2] == (camera.height, camera.width):
        return frame
    rgb = cv2.resize(frame.rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    depth = frame.depth
    native = frame.mask if frame.native_mask is None else frame.native_mask
    return replace(
        frame,
        rgb=np.asarray(rgb, np.uint8),
        depth=None if depth is None else reduce_depth(depth, camera.width, camera.height),
        mask=None if native is None else resize_labels(native, camera.width, camera.height),
        sensor_depth=depth,
        native_mask=native,
    )
