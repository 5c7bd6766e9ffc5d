# SPDX-License-Identifier: Apache-2.0
"""Colour and depth of one moment are told from those of others, on the built-in office and on recordings."""

from pathlib import Path

import numpy as np
import pytest

from ggwarp.datasets import open_dataset
from ggwarp.datasets.base import at_scale
from ggwarp.datasets.plan.correspondence import (
    LEAST_AGREEMENT,
    agreement,
    edges_of_depth,
    gradients_of_colour,
    judge,
    neighbours,
)
from ggwarp.types import Frame


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    office = at_scale(open_dataset("office", data_root=Path("absent")), 0.25)
    return [office[i] for i in range(16)]


def said(frames: list[Frame], depth_of: list[int]) -> str:
    depths = [frames[i].depth for i in depth_of]
    return judged(frames, [depth for depth in depths if depth is not None])


def judged(frames: list[Frame], depths: list[np.ndarray], looked_at: range = range(3, 13, 2)) -> str:
    edges = {i: edges_of_depth(depths[i]) for i in neighbours(looked_at, len(depths))}
    return judge({i: frames[i].rgb for i in looked_at}, edges)


def test_what_belongs_together_is_not_doubted(frames: list[Frame]) -> None:
    assert said(frames, list(range(16))) == ""
    for frame in frames[:2]:
        assert frame.depth is not None
        assert agreement(gradients_of_colour(frame.rgb), edges_of_depth(frame.depth)) > 3.0


@pytest.mark.parametrize(
    ("shift", "says"), [(1, "1 frame earlier"), (-1, "1 frame later"), (2, "2 frames earlier")]
)
def test_depth_of_a_neighbour_is_named(frames: list[Frame], shift: int, says: str) -> None:
    assert said(frames, [min(max(i + shift, 0), 15) for i in range(16)]).startswith(
        f"the depth of {says} fits"
    )


def test_swapped_and_mirrored_depth_is_told(frames: list[Frame]) -> None:
    mirrored = [np.ascontiguousarray(f.depth[:, ::-1]) for f in frames if f.depth is not None]
    reason = judged(frames, mirrored)
    assert reason.startswith("edges of the depth do not lie on edges of the pictures")


def test_too_few_edges_or_frames_say_nothing(frames: list[Frame]) -> None:
    assert judged(frames, [np.full((170, 300), 2.0, np.float32)] * 16) == ""
    assert judged(frames, [frame.depth for frame in frames[::-1] if frame.depth is not None], range(2)) == ""
    assert judge({0: frames[0].rgb}, {}) == "" == judge({}, {})


def test_neighbours_rise_and_stay_inside() -> None:
    assert neighbours([4, 0], 6) == [0, 1, 2, 3, 4, 5]


def test_edges_are_on_the_nearer_side_and_not_at_holes() -> None:
    depth = np.full((8, 12), 2.0, np.float32)
    depth[:, 5:], depth[3:5, 8:10] = 3.0, 0.0
    edges = edges_of_depth(depth)
    assert edges[:, 4].all() and edges.sum() == 8


@pytest.mark.parametrize("exposure", [0.3, 1.0])
def test_how_bright_a_picture_is_does_not_count(frames: list[Frame], exposure: float) -> None:
    rgb = (frames[0].rgb * exposure).astype(np.uint8)
    assert frames[0].depth is not None
    assert agreement(gradients_of_colour(rgb), edges_of_depth(frames[0].depth)) > 3.0 > LEAST_AGREEMENT
