# SPDX-License-Identifier: Apache-2.0
"""A second pass over the frames is the first one again, whatever was held of it."""

from __future__ import annotations

import numpy as np
import pytest

from ggwarp.datasets.base import FrameError
from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.datasets.kept_frames import KeptFrames
from ggwarp.datasets.reader import FrameReader
from ggwarp.types import Frame

SCALE = 0.1
PIXELS = 120 * 68


class Office(SyntheticOffice):
    """The office, whose frame 3 can be read once."""

    def __init__(self) -> None:
        super().__init__(frames=6)
        self.read: list[int] = []

    def scaled(self, scale: float) -> Office:
        scaled = super().scaled(scale)
        assert isinstance(scaled, Office)
        return scaled

    def __getitem__(self, index: int) -> Frame:
        if index == 3 and index in self.read:
            raise FrameError("frame 3 has gone")
        self.read.append(index)
        return super().__getitem__(index)


@pytest.mark.parametrize(("held", "budget"), [(0, 0), (2, 4 * 2 * 27 * PIXELS), (6, 1 << 30)])
def test_frames_come_again_in_order(held: int, budget: int) -> None:
    office = Office()
    kept = KeptFrames(office, scale=SCALE, budget=budget)
    with FrameReader(office, range(6), scale=SCALE) as reader:
        first = [frame for frame in reader if isinstance(frame, Frame)]
    for frame in first:
        kept.keep(frame)
    assert len(kept) == held and kept.room >= 0
    wanted = [0, 1, 2, 4, 5] if held < 6 else [0, 1, 2, 3, 4, 5]

    again = list(kept.again([0, 1, 2, 3, 4, 5]))

    assert [frame.index for frame in again] == wanted, "what cannot be read again is left out"
    assert len(office.read) == len(first) + len(wanted) - held
    for frame in again:
        one = first[frame.index]
        for name in ("rgb", "depth", "mask", "native_mask", "true_mask", "T_wc"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(one, name))
