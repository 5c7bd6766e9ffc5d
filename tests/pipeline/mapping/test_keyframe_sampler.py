# SPDX-License-Identifier: Apache-2.0
from collections import Counter
from collections.abc import Iterable

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.map.covisibility import Visibility
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.submaps import Submaps
from ggwarp.pipeline.mapping.keyframe_sampler import RandomSampler, WindowSampler
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig
from ggwarp.types import Float64

WHOLE = Submaps(
    GaussianMap(device="cpu", has_identity=False, capacity=1), Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
)
"""Of a map all of which is in memory."""


def one(sampler: RandomSampler | WindowSampler) -> int:
    """Return the next keyframe, of a map that is all in memory."""
    [number] = sampler.next()
    return number


def test_the_newest_comes_first_and_once(rng: np.random.Generator) -> None:
    sampler = RandomSampler(rng, WHOLE)
    for _ in range(50):
        sampler.add()
    assert one(sampler) == 49
    sampler.add()
    assert one(sampler) == 50
    assert Counter(one(sampler) for _ in range(200)).most_common(1)[0][1] < 30


def sampler_along_a_corridor(rng: np.random.Generator, steps: int) -> WindowSampler:
    """A keyframe each 0.2 m; views reach one metre, so that three metres back nothing is shared."""

    def look(T_wc: Float64) -> Visibility:
        centres = np.arange(1000) / 50.0
        return Visibility(np.abs(centres - T_wc[0, 3]) < 0.5, 1.0)

    def pose(k: int) -> Float64:
        T = np.eye(4)
        T[0, 3] = 0.2 * k
        return T

    sampler = WindowSampler(rng, WindowConfig(size=4, cutoff=0.4), look, pose, WHOLE)
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
        drawn = [one(sampler) for _ in range(size)]
        assert drawn[0] == 19
        assert len(set(drawn)) == size and set(sampler.window) <= set(drawn)
        past |= set(drawn) - set(sampler.window)
    assert len(past) > 10, "all of the past has its turn"


def test_the_first_keyframe_is_all_there_is(rng: np.random.Generator) -> None:
    sampler = sampler_along_a_corridor(rng, 1)
    assert [one(sampler) for _ in range(3)] == [0, 0, 0]


def test_a_new_keyframe_starts_a_new_round(rng: np.random.Generator) -> None:
    sampler = sampler_along_a_corridor(rng, 2)
    one(sampler)
    sampler.add()
    assert sorted(one(sampler) for _ in range(3)) == [0, 1, 2]


def test_views_of_an_earlier_map_are_of_the_past(rng: np.random.Generator) -> None:
    random = RandomSampler(rng, WHOLE)
    for _ in range(4):
        random.add_earlier()
    random.add()
    assert one(random) == 4 and {one(random) for _ in range(100)} == set(range(5))
    window = sampler_along_a_corridor(rng, 0)
    for _ in range(4):
        window.add_earlier()
    window.add()
    assert window.window == [4]
    drawn = [one(window) for _ in range(3)]
    assert 4 in drawn and len({*drawn} & {0, 1, 2, 3}) == 2


class Halves(Submaps):
    """Keyframes 0 to 4 and 5 to 9 see one half of a map each, of which one is in memory."""

    def __init__(self) -> None:
        super().__init__(WHOLE._map, Camera(64, 48, 60.0, 60.0, 31.5, 23.5))
        self.there, self.visits, self.home = 1, 0, 1

    def of_keyframe(self, keyframe: int) -> int:
        return keyframe // 5

    def hidden_keyframes(self) -> np.ndarray:
        return np.arange(10) // 5 != self.there

    def visit(self, keyframes: Iterable[int]) -> None:
        self.visited = list(keyframes)
        halves = {self.of_keyframe(k) for k in self.visited}
        self.visits += len(halves)
        self.there = halves.pop() if halves else self.home


def test_what_is_out_of_memory_has_its_iterations_later() -> None:
    """The very draws of a map in one piece, each when what it sees is in memory."""
    halves = Halves()
    cut, whole = (RandomSampler(np.random.default_rng(3), submaps) for submaps in (halves, WHOLE))
    for _ in range(10):
        cut.add()
        whole.add()
    drawn, expected = Counter[int](), Counter(one(whole) for _ in range(999))
    for k in range(999):
        halves.home = k // 300 % 2  # the camera goes to and fro
        numbers = cut.next()
        assert not halves.hidden_keyframes()[numbers].any(), "what they see is there"
        drawn.update(numbers)
        assert k - 2 * 8 < drawn.total() <= k + 1, "none waits for long"
    assert halves.visits < 999 / 2 / 8 + 2, "not for every draw"
    assert drawn != expected
    while numbers := cut.put_off():
        assert not halves.hidden_keyframes()[numbers].any()
        drawn.update(numbers)
    assert drawn == expected


def test_a_window_leaves_out_what_is_out_of_memory(rng: np.random.Generator) -> None:
    sampler = sampler_along_a_corridor(rng, 10)
    sampler._submaps = Halves()
    drawn = {one(sampler) for _ in range(60)}
    assert 9 in drawn and min(drawn) == 5
