# SPDX-License-Identifier: Apache-2.0
"""tools/benchmark.py memory: a walk that goes on, and what is measured on it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarking.endurance import memory
from benchmarking.endurance.walk import Walk
from benchmarking.options import BenchmarkError
from benchmarking.record import Record, Section
from ggwarp.datasets import SyntheticOffice
from ggwarp.datasets.reader import FrameReader
from ggwarp.types import Frame


class Recording(SyntheticOffice):
    """The office as a recording: depth is taken 5 ms after the colour."""

    def __getitem__(self, index: int) -> Frame:
        frame = super().__getitem__(index)
        return Frame(
            index, index / 10.0, frame.rgb, frame.depth, None, frame.T_wc, None, index / 10.0 + 0.005
        )


def test_a_recording_is_walked_to_and_fro_and_a_loop_round() -> None:
    walk = Walk(Recording(frames=40, scale=0.05), length=4, frames=9)
    assert len(walk) == 9 and walk.period == 6
    truth = SyntheticOffice(frames=40).trajectory
    offsets = []
    for k, at in enumerate([0, 1, 2, 3, 2, 1, 0, 1, 2]):
        frame = walk[k]
        assert frame.index == k and frame.timestamp == pytest.approx(k / 10.0)
        np.testing.assert_array_equal(frame.T_wc, truth[at])
        assert frame.depth_timestamp is not None
        offsets.append(frame.depth_timestamp - frame.timestamp)
    assert np.sign(offsets).tolist() == [1, 1, 1, 1, -1, -1, 1, 1, 1], "backwards, time runs backwards"

    loop = Walk(SyntheticOffice(frames=5, scale=0.05), length=5, frames=10)
    assert loop.period == 4
    np.testing.assert_array_equal(loop[6].T_wc, loop[2].T_wc)


def test_a_walk_is_a_data_set() -> None:
    walk = Walk(SyntheticOffice(frames=5), length=5, frames=3)
    with FrameReader(walk, range(3), scale=0.05) as reader:
        frames = [frame for frame in reader if isinstance(frame, Frame)]
    assert [frame.index for frame in frames] == [0, 1, 2] and frames[0].rgb.shape == (34, 60, 3)


def test_checks_look_at_what_comes_after_the_second_round() -> None:
    rows = [
        {
            "frames": 10 * k,
            "resident MB": 100.0 + k,
            "Gaussians": 50 * k if k < 4 else 200,
            "tracking ms": 9.0,
        }
        | {"trackable points": 10 * k}
        for k in range(1, 21)
    ]
    resident, gaussians, points, time = memory.checks(rows, period=20)
    assert resident.value == 120.0 and resident.met
    assert gaussians.value == 1.0 and gaussians.met
    assert points.value == 5.0 and not points.met
    assert time.value == 1.0 and time.met
    assert memory.checks(rows[:2], period=20)[1].met is None, "too short to say"


def section_of(record: Record) -> Section:
    section = record.section(memory.COURSE)
    assert section is not None
    return section


def test_a_walk_is_measured(tmp_path: Path) -> None:
    options = memory.MemoryOptions(device="cpu", frames=7, length=4, scale=0.1, memory=0.0, data=tmp_path)
    record = memory.run(options)
    section = section_of(record)
    assert [row["frames"] for row in section.rows] == list(range(1, 8))
    last = section.rows[-1]
    assert last["Gaussians"] > 1000 and last["keyframes"] > 1 and last["lost"] == 0
    assert last["in the file MB"] > 0.0 and last["images in memory MB"] < 0.5 < last["resident MB"]
    assert record.settings["image"] == "120x68" and "width" not in last
    bounded = dataclasses.replace(options, map_memory=0.0, points=900, minutes=0.0)
    [row] = section_of(memory.run(bounded)).rows
    assert row["frames"] == 1 and row["Gaussians in memory"] == row["Gaussians"], "all of it is in view"
    with pytest.raises(BenchmarkError, match="at least 3"):
        memory.run(memory.MemoryOptions(device="cpu", length=2, data=tmp_path))
