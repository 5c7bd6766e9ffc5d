# SPDX-License-Identifier: Apache-2.0
"""Arrays that are too many to hold: some in memory, the others compressed in a file without a name.

A run keeps the images of every keyframe and looks at one of them at a time. Those used last stay on the
device, up to a budget; the others go to a temporary file that the system removes however the program ends, as
it has no name from the start. zlib at its fastest takes a third of the space of colour and a seventh of
depth's: a keyframe of 640x480 is 0.8 of 3.4 MB, written in 22 ms and read in 8, one core. PNG is as small for
colour and takes twice as long; Blosc's fast codecs read in 4 ms, but take a third more and are one more
package. An iteration on such an image takes hundreds of milliseconds on the machines that need the file.
"""

from __future__ import annotations

import errno
import logging
import os
import tempfile
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.runtime.streams import to_host
from ggwarp.types import StoredArray

log = logging.getLogger(__name__)

_LEVEL = 1
_BLOCK = 4096
"""Places in the file are whole blocks with a quarter to spare, so that labels that change fit again."""
_HELD = 4
"""So many arrays used last stay in memory, whatever the budget: all that a keyframe has at most."""


@dataclass(frozen=True)
class _Place:
    """Where a copy lies in the file: ``size`` of ``room`` bytes from ``offset``; and what it is a copy of."""

    offset: int
    room: int
    size: int
    shape: tuple[int, ...]
    host_dtype: np.dtype[Any]
    dtype: Any


class ImageStore:
    """Arrays by key, at most ``budget`` bytes of them in memory. For one thread, but for :meth:`joined`.

    To save all of it, go over :meth:`keys` and :meth:`get`; to restore it, :meth:`put` them in that order.
    What is in memory and what in the file does not matter to any result.

    Attributes:
        device: Warp device of the arrays in memory.
        held: their bytes.
    """

    def __init__(
        self,
        *,
        device: Any,
        budget: int | None = None,
        folder: Callable[[], Path] | None = None,
        level: int = _LEVEL,
    ) -> None:
        """Make an empty store.

        Args:
            device: Warp device of the arrays in memory.
            budget: bytes; None: all stay in memory.
            folder: tells where the file will be, when it is first needed; None: the temporary folder.
            level: of zlib; 0 for what does not compress: arrays are then written as they are.
        """
        self.device, self._budget, self._folder, self._level = device, budget, folder, level
        self._arrays: OrderedDict[Hashable, wp.array] = (
            OrderedDict()
        )  # in memory, the one used last at the end
        self._places: dict[Hashable, _Place] = {}
        self._keys: dict[
            Hashable, bool
        ] = {}  # in the order they came; whether the file has the array as it is
        self._file: IO[bytes] | None = None
        self._lock = threading.Lock()  # of where the file is at
        self._end = 0
        self.held = 0

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._keys

    def keys(self) -> list[Hashable]:
        """Return all keys, in the order in which they first came."""
        return list(self._keys)

    @property
    def folder(self) -> Callable[[], Path] | None:
        """Tells where the file is or will be; None: all stays in memory."""
        return None if self._budget is None else self._folder or (lambda: Path(tempfile.gettempdir()))

    @property
    def stored(self) -> int:
        """Bytes of the file."""
        return self._end

    def put(self, key: Hashable, array: wp.array) -> None:
        """Keep ``array``, contiguous, which is the store's from now on; once more after it was changed."""
        old = self._arrays.pop(key, None)
        self.held += array.capacity - (0 if old is None else old.capacity)
        self._arrays[key] = array
        self._keys[key] = False
        self._make_room()

    def get(self, key: Hashable) -> wp.array:
        """Return the array of ``key``; who changes it puts it back.

        Raises:
            KeyError: there is none.
            OSError: it cannot be read any more.
        """
        if key in self._arrays:
            self._arrays.move_to_end(key)
            return self._arrays[key]
        place = self._places[key]
        array = wp.array(self._read(place), dtype=place.dtype, device=self.device)
        self.held += array.capacity
        self._arrays[key] = array
        self._make_room()
        return array

    def joined(self, keys: Sequence[Hashable]) -> StoredArray:
        """Return the arrays of ``keys``, at least one, joined along their first axis, for a state.

        What is in the file is read when the parts are asked for, by any thread, and is not kept in memory;
        that raises an OSError where one of them has been written anew since.
        """
        sources = [self._arrays[key] if key in self._arrays else self._places[key] for key in keys]

        def parts() -> Iterator[NDArray[Any]]:
            for key, source in zip(keys, sources, strict=True):
                if isinstance(source, _Place):
                    if self._places.get(key) is not source:
                        raise OSError(errno.ESTALE, "a temporary file has changed since")
                    yield self._read(source)
                else:
                    yield to_host(source)

        of_host = [
            (source.shape, source.host_dtype)
            if isinstance(source, _Place)
            else (to_host(source).shape, to_host(source).dtype)
            for source in sources
        ]
        (_, *rest), dtype = of_host[0]
        return StoredArray(dtype, (sum(shape[0] for shape, _ in of_host), *rest), parts)

    def clear(self) -> None:
        """Forget everything."""
        self._arrays.clear()
        self._places.clear()
        self._keys.clear()
        self.held = self._end = 0
        if self._file is not None:
            self._file.close()
            self._file = None

    def _make_room(self) -> None:
        """Write what was used longest ago to the file until the rest fits."""
        while self._budget is not None and self.held > self._budget and len(self._arrays) > _HELD:
            key = next(iter(self._arrays))
            if not self._keys[key]:
                try:
                    self._write(key, self._arrays[key])
                except OSError as error:
                    self._budget = None
                    log.warning("images, or a part of the map, stay in memory: no file for them (%s)", error)
                    return
            self.held -= self._arrays.pop(key).capacity

    def _write(self, key: Hashable, array: wp.array) -> None:
        image = to_host(array)
        packed = zlib.compress(image.tobytes(), self._level)
        place = self._places.get(key)
        if place is None or place.room < len(packed):
            offset, room = self._end, -(-(len(packed) + len(packed) // 4) // _BLOCK) * _BLOCK
        else:
            offset, room = place.offset, place.room
        file = self._opened()
        with self._lock:
            file.seek(offset)
            if file.write(packed) != len(packed):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._end = max(self._end, offset + room)
        self._places[key] = _Place(offset, room, len(packed), image.shape, image.dtype, array.dtype)
        self._keys[key] = True

    def _read(self, place: _Place) -> NDArray[Any]:
        assert self._file is not None, "what has a place was written"
        with self._lock:
            self._file.seek(place.offset)
            packed = self._file.read(place.size)
        try:
            data = zlib.decompress(packed)
        except zlib.error as error:
            raise OSError(errno.EIO, f"the temporary file of images is damaged ({error})") from None
        return np.frombuffer(data, place.host_dtype).reshape(place.shape)

    def _opened(self) -> IO[bytes]:
        if self._file is None:
            folder = None if self._folder is None else self._folder()
            # Unbuffered: a frame's images are written and read whole.
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)
        return self._file
