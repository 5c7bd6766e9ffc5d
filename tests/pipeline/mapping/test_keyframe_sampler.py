# SPDX-License-Identifier: Apache-2.0
from collections import Counter

import numpy as np

from ggwarp.map.covisibility import Visibility
from ggwarp.pipeline.mapping.keyframe_sampler import RandomSampler, WindowSampler
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig
from ggwarp.types import Float64


def test_the_newest_comes_first_and_once(rng: np.random.Generator) -> None:
    sampler = RandomSampler(rng)
    for _ in range(50):
        sampler.add()
    assert sampler.next() == 49
    sampler.add()
    assert sampler.next() == 50
    assert Counter(sampler.next() for _ in range(200)).most_common(1)[0][1] < 30


def sampler_along_a_corridor(rng: np.random.Generator, steps: int) -> WindowSampler:
    """A keyframe each 0.2 m; views reach one metre, so that three metres back nothing is shared."""

    def look(T_wc: Float64) -> Visibility:
        centres = np.arange(1000) / 50.0
        return Visibility(np.abs(centres - T_wc[0, 3]) < 0.5, 1.0)

    def pose(k: int) -> Float64:
        T = np.eye(4)
        T[0, 3] = 0.2 * k
        return T

    sampler = WindowSampler(rng, WindowConfig(size=4, cutoff=0.4), look, pose)
    for _ in range(steps):
        sampler.add()
    return sampler


def test_a_round_is_the_window_and_two_of_the_past(rng: np.random.Generator) -> None:
    sampler = sampler_along_a_corridor(rng, 20)
    assert sampler.window[-2:] == [18, 19]
    assert len(sampler.window) <= 4 and min(sampler.window) >= 16
    size = len(sampler.window) + 2
    past = set()
    for _ in range(20):
        drawn = [sampler.next() for _ in range(size)]
        assert drawn[0] == 19
        assert len(set(drawn)) == size and set(sampler.window) <= set(drawn)
        past |= set(drawn) - set(sampler.window)
    assert len(past) > 10, "all of the past has its turn"


def test_the_first_keyframe_is_all_there_is(rng: np.random.Generator) -> None:
    sampler = sampler_along_a_corridor(rng, 1)
    assert [sampler.next() for _ in range(3)] == [0, 0, 0]


def test_a_new_keyframe_starts_a_new_round(rng: np.random.Generator) -> None:
    sampler = sampler_along_a_corridor(rng, 2)
    sampler.next()
    sampler.add()
    assert sorted(sampler.next() for _ in range(3)) == [0, 1, 2]


def test_views_of_an_earlier_map_are_of_the_past(rng: np.random.Generator) -> None:
    random = RandomSampler(rng)
    for _ in range(4):
        random.add_earlier()
    random.add()
    assert random.next() == 4 and {random.next() for _ in range(100)} == set(range(5))
    window = sampler_along_a_corridor(rng, 0)
    for _ in range(4):
        window.add_earlier()
    window.add()
    assert window.window == [4]
    drawn = [window.next() for _ in range(3)]
    assert 4 in drawn and len({*drawn} & {0, 1, 2, 3}) == 2
