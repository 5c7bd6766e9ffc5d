# SPDX-License-Identifier: Apache-2.0
"""Frames for a second pass over a sequence: as many as may be are held, the others read again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator

from ggwarp.datasets.base import Dataset
from ggwarp.datasets.reader import FrameReader
from ggwarp.types import Frame

_BYTES = 1 << 29
"""Frames of a short run are held, which spares reading them again; a long run is on disk already."""

_SHARE = 4
"""They take no more than this part of the memory that a run's images may have."""


class KeptFrames:
    """Holds frames that were read.

    Attributes:
        room: bytes that may still be taken.
    """

    def __init__(
        self, dataset: Dataset, *, scale: float, budget: int, stopped: Callable[[], bool] = lambda: False
    ) -> None:
        """Hold none yet.

        Args:
            dataset, scale, stopped: as of :class:`ggwarp.datasets.reader.FrameReader`.
            budget: bytes of all the images of a run, keyframes' included.
        """
        self._dataset, self._scale, self._stopped = dataset, scale, stopped
        self._frames: dict[int, Frame] = {}
        self.room = min(_BYTES, budget // _SHARE)

    def __len__(self) -> int:
        return len(self._frames)

    def keep(self, frame: Frame) -> None:
        """Hold ``frame``, without its sensor's depth and its weights, if there is room."""
        pictures = (frame.rgb, frame.depth, frame.mask, frame.native_mask, frame.true_mask)
        images = {id(image): image for image in pictures if image is not None}
        size = sum(image.nbytes for image in images.values())
        if size <= self.room:
            self.room -= size
            self._frames[frame.index] = dataclasses.replace(frame, sensor_depth=None, depth_weight=None)

    def again(self, indices: Iterable[int]) -> Iterator[Frame]:
        """Yield the frames ``indices``, in that order; those are left out that can no longer be read."""
        wanted = list(indices)
        others = [index for index in wanted if index not in self._frames]
        with FrameReader(self._dataset, others, scale=self._scale, stopped=self._stopped) as reader:
            read = iter(reader)
            for index in wanted:
                frame = self._frames.get(index) or next(read, None)
                if isinstance(frame, Frame):
                    yield frame
