# SPDX-License-Identifier: Apache-2.0
"""A sequence whose frames come once, in order, and end when they end."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import (
    MOST_LIVE_FRAMES,
    DatasetError,
    FrameError,
    MaskChoice,
    Masks,
    SequenceEnd,
)
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import shown_size, size_of
from ggwarp.datasets.source import Source
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float32, Float64, Frame

T = TypeVar("T")

_HELD = 2
"""Pictures that wait at most: more would only be older."""


class LivePicture(NamedTuple):
    """What a camera took.

    Attributes:
        timestamp: seconds.
        rgb: [h, w, 3] uint8, RGB, at the colour camera's size.
        depth: [h', w'] float32 metres by the depth camera; None: there is none.
        T_wc: [4, 4] true camera-to-world pose, when known.
        depth_weight: [h', w'] float32 how much each reading counts, 0 to 1; None: all alike.
        camera: the colour camera of this picture, where it is another than the sequence's.
    """

    timestamp: float
    rgb: NDArray[np.uint8]
    depth: Float32 | None = None
    T_wc: Float64 | None = None
    depth_weight: Float32 | None = None
    camera: Camera | None = None


class LiveSequence:
    """A :class:`ggwarp.datasets.base.Dataset` of pictures that come once.

    Attributes:
        live: true; frames can be read once, in rising order, and their number is not known.
    """

    live = True
    has_masks = False

    def __init__(
        self,
        kind: str,
        pictures: Iterator[LivePicture | FrameError],
        calibration: Calibration,
        *,
        has_depth: bool,
        layout: str,
        dropped: Callable[[], int] = lambda: 0,
    ) -> None:
        """Begin where ``pictures`` do.

        Args:
            pictures: what comes; a FrameError stands for a frame that cannot be used.
            dropped: returns how many pictures came and were not waited for.

        Raises:
            DatasetError: the distortion leaves nothing of the picture.
        """
        self.name = self.kind = kind
        self.camera = calibration.camera
        self.has_depth = has_depth
        self.depth_scale = calibration.depth_scale
        self.stems: list[str] = []
        self.source = Source(
            layout=layout,
            camera=calibration.origin,
            depth_unit=calibration.depth_unit if has_depth else "",
            notes=calibration.notes,
        )
        self._pictures, self._rig, self._dropped = pictures, calibration.rig(), dropped
        self._lock = threading.Lock()
        self._next = 0

    @property
    def dropped(self) -> int:
        """Pictures that came while those before were at work, and are lost."""
        return self._dropped()

    def __len__(self) -> int:
        """Return more frames than will come."""
        return MOST_LIVE_FRAMES

    def __getitem__(self, index: int) -> Frame:
        """Return frame ``index``, having waited for it and passed by those before.

        Raises:
            FrameError: it cannot be used, or has gone by.
            SequenceEnd: no more frames come.
        """
        with self._lock:
            if index < self._next:
                raise FrameError(f"{self.name}: frame {index} came once and is gone")
            picture: LivePicture | FrameError | None = None
            while self._next <= index:
                picture = next(self._pictures, None)
                if picture is None:
                    raise SequenceEnd
                self._next += 1
        if isinstance(picture, FrameError):
            raise picture
        assert picture is not None
        return self._frame(index, picture)

    def _frame(self, index: int, picture: LivePicture) -> Frame:
        wanted, found = (self.camera.width, self.camera.height), size_of(picture.rgb)
        if found != wanted:
            raise FrameError(f"{self.name}: frame {index} is {shown_size(found)}, not {shown_size(wanted)}")
        depth, weight = picture.depth, picture.depth_weight
        if self.has_depth and depth is None:
            raise FrameError(f"{self.name}: frame {index} has no depth")
        if depth is not None and not self._rig.fits(*size_of(depth)):
            raise FrameError(
                f"{self.name}: the depth of frame {index} is {shown_size(size_of(depth))}, but "
                f"{self._rig.wanted_depth}"
            )
        return Frame(
            index,
            picture.timestamp,
            self._rig.colour(picture.rgb, picture.camera),
            None if depth is None else self._rig.depth(depth, picture.camera),
            T_wc=picture.T_wc,
            depth_weight=None if weight is None else self._rig.weights(weight, picture.camera),
        )


class Newest(Generic[T]):
    """Iterates over what a camera gives, by a thread of its own; what is not taken in time is dropped.

    The thread is never waited for: a camera that answers no more does not hold the program.
    """

    def __init__(self, take: Callable[[], T | None]) -> None:
        """Begin to take.

        Args:
            take: returns what comes next, waiting for it; None: nothing comes any more.
        """
        self.dropped = 0
        self._take = take
        self._waiting: deque[T] = deque()
        self._changed = threading.Condition()
        self._ended = False
        self.thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            while (item := self._take()) is not None:
                with self._changed:
                    if len(self._waiting) == _HELD:
                        self._waiting.popleft()
                        self.dropped += 1
                    self._waiting.append(item)
                    self._changed.notify()
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        with self._changed:
            while not self._waiting:
                if self._ended:
                    raise StopIteration
                self._changed.wait()
            return self._waiting.popleft()


def no_masks(masks: Masks, what: str) -> None:
    """Refuse masks, which frames that are not there yet cannot have.

    Raises:
        DatasetError: there are some.
    """
    where = MaskChoice.of(masks).where
    if where is not None and str(where) != "none":
        raise DatasetError(f"--masks {where}: {what} has no masks; leave the option out")
