# SPDX-License-Identifier: Apache-2.0
"""State as a tree: what is packed comes back, in place where others hold it, and nothing else is made."""

from __future__ import annotations

import json
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp

from ggwarp.kernels.math import vec16
from ggwarp.runtime.state import StateError, Stateful, pack, reread, state_value, unpack
from ggwarp.types import Frame, Verdict


@state_value
@dataclass(frozen=True)
class Shelf:
    name: str
    position: np.ndarray
    visits: int = 0


class Walker(Stateful):
    """Holds one of every kind."""

    STATE = ("steps", "seen", "recent", "counts", "places", "by_id", "rng", "array", "inner", "last")

    def __init__(self, device: str, inner: bool = True) -> None:
        self.steps, self.seen = 0, set[int]()
        self.recent: deque[tuple[int, np.ndarray]] = deque(maxlen=2)
        self.counts: Counter[tuple[int, int]] = Counter()
        self.places: list[Shelf] = []
        self.by_id: dict[int, Any] = {}
        self.rng = np.random.default_rng(1)
        self.array = wp.zeros(3, dtype=vec16, device=device)
        self.inner = Walker(device, False) if inner else None
        self.last: np.ndarray | None = None
        self.scratch = "not kept"


def no_frame(index: int) -> Frame:
    raise AssertionError("no frame is asked for")


def through_json(tree: Any) -> Any:
    """Return ``tree`` as a file gives it back: arrays as they are, all else by JSON."""
    if isinstance(tree, dict):
        assert all(isinstance(key, str) for key in tree)
        return {key: through_json(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [through_json(value) for value in tree]
    return tree if isinstance(tree, np.ndarray) else json.loads(json.dumps(tree))


def walked(device: str) -> Walker:
    walker = Walker(device)
    for w in (walker, walker.inner):
        assert w is not None
        w.steps, w.seen, w.last = 7, {3, 1}, np.arange(3.0)
        for i in range(3):
            w.recent.append((i, np.full(2, i)))
        w.counts[4, 2] = 5
        w.counts[1, 1] = 1
        w.places = [Shelf("a", np.zeros((2, 3))), Shelf("b", np.ones((0, 3)), 4)]
        w.by_id = {9: [Verdict.LOST, {1, 2}], 2: "two", 5: {"text": (1.0, None)}}
        w.rng.random(3)
        w.array.assign(np.arange(48, dtype=np.float32).reshape(3, 16))
    return walker


def test_two_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match=r"Shelf: .* has one of that name already"):
        state_value(dataclass(type("Shelf", (), {})))
    assert state_value(Shelf) is Shelf


def test_every_kind_comes_back(device: str) -> None:
    walker, other = walked(device), Walker(device)
    array, rng, inner = other.array, other.rng, other.inner
    other.restore(through_json(walker.state()), no_frame)
    assert other.array is array and other.rng is rng and other.inner is inner, "in place"
    for one, two in ((walker, other), (walker.inner, other.inner)):
        assert one is not None and two is not None
        assert (two.steps, two.seen, two.counts) == (7, {1, 3}, Counter({(4, 2): 5, (1, 1): 1}))
        assert list(two.counts) == [(4, 2), (1, 1)], "in their order"
        assert two.recent.maxlen == 2 and [i for i, _ in two.recent] == [1, 2]
        assert [(p.name, p.visits, p.position.shape) for p in two.places] == [
            ("a", 0, (2, 3)),
            ("b", 4, (0, 3)),
        ]
        assert two.by_id == one.by_id and list(two.by_id) == [9, 2, 5]
        assert two.rng.random() == one.rng.random()
        np.testing.assert_array_equal(two.array.numpy(), one.array.numpy())
        assert two.last is not None and two.last.tolist() == [0, 1, 2]


def test_a_state_is_a_copy(device: str) -> None:
    walker = walked(device)
    state = walker.state()
    walker.array.zero_()
    assert walker.last is not None
    walker.last[:] = 9.0
    assert state["array"][2, 15] == 47.0 and state["last"].tolist() == [0, 1, 2]


def test_an_array_of_another_size_is_another(device: str) -> None:
    walker, other = walked(device), Walker(device)
    other.array = wp.zeros(8, dtype=vec16, device=device)
    other.restore(walker.state(), no_frame)
    assert other.array.shape == (3,) and other.array.dtype is vec16
    state = walker.state() | {"array": np.zeros((3, 4), np.float32)}
    with pytest.raises(StateError, match="rows of another kind"):
        other.restore(state, no_frame)


def test_only_what_is_known_is_packed_and_made() -> None:
    @dataclass
    class Unknown:
        x: int = 0

    for value in (Unknown(), object(), lambda: 0, [Unknown()], {1: Unknown()}):
        with pytest.raises(TypeError, match="a state cannot hold"):
            pack(value)
    for tree in ({"$": "value", "type": "Popen", "fields": {}}, {"$": "enum", "type": "os", "value": 0}):
        with pytest.raises(KeyError):
            unpack(tree, no_frame)
    with pytest.raises(StateError, match="kind 'code' is not known"):
        unpack({"$": "code"}, no_frame)


def test_a_frame_goes_by_reference_and_must_be_the_same() -> None:
    rgb, depth = np.full((4, 5, 3), 9, np.uint8), np.ones((4, 5), np.float32)
    frame = Frame(3, 0.1, rgb, depth, sensor_depth=depth)
    tree = pack([frame])
    assert "rgb" not in str(tree)
    assert unpack(tree, lambda index: {3: frame}[index])[0] is frame
    with pytest.raises(StateError, match="frame 3 of the sequence is not the one that it was"):
        unpack(tree, lambda index: Frame(3, 0.1, rgb, depth + 1.0))
    assert (
        reread(lambda index: frame, 3, pack(Frame(3, 0.1, rgb))["checksum"], with_depth=False).depth is None
    )
