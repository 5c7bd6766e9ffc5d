# SPDX-License-Identifier: Apache-2.0
"""Which keyframe the next mapping iteration is spent on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ggwarp.map.covisibility import Look, Seen
from ggwarp.map.submaps import Submaps
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig, keyframes_that_leave, unconfirmed
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float64

_FETCHED = 8
"""So many iterations wait for a submap before it is fetched for them: for one it costs as much as that."""

_PAST = 2
"""Keyframes outside the window that each round takes in, so that the past is not forgotten (MonoGS)."""


class KeyframeSampler(Protocol):
    """Chooses keyframes, numbered in the order in which they came."""

    @property
    def window(self) -> list[int]:
        """The keyframes that are fitted together, the newest last."""
        ...

    def add(self) -> None:
        """Take in the next keyframe."""
        ...

    def add_earlier(self) -> None:
        """Take in a view of an earlier map, before any keyframe: it is of the past."""
        ...

    def next(self) -> list[int]:
        """Return what to fit the map to now, all of it in memory: one keyframe, or what was put off; or none.

        There must be keyframes.
        """
        ...

    def put_off(self) -> list[int]:
        """Return some of what is still put off, all of it in memory then; none: nothing is."""
        ...

    def unconfirmed(self, keyframe_ids: Callable[[], NDArray[np.int32]]) -> Seen | None:
        """Return [n] which Gaussians too few keyframes see; None: that cannot be told, or is not asked for.

        Args:
            keyframe_ids: tells the number of the keyframe that brought each Gaussian, [n].
        """
        ...


class RandomSampler(Stateful):
    """The newest keyframe first, once; then any, at random (GS-ICP-SLAM).

    An iteration on a keyframe that is out of memory is put off until that is back, or until some wait for its
    submap, which is then fetched. The draws are those of a map that is all in memory.
    """

    STATE = ("_rng", "_count", "_newest_pending", "_put_off")

    def __init__(self, rng: np.random.Generator, submaps: Submaps) -> None:
        """Start without keyframes; ``submaps`` tells which of them are out of memory."""
        self._rng, self._submaps = rng, submaps
        self._count = 0
        self._newest_pending = False
        self._put_off: list[int] = []  # as they were drawn

    def add(self) -> None:
        self._count += 1
        self._newest_pending = True

    def add_earlier(self) -> None:
        self._count += 1

    def next(self) -> list[int]:
        self._leave()
        if self._newest_pending:
            self._newest_pending = False
            return [self._count - 1]
        number = int(self._rng.integers(self._count))
        hidden = self._submaps.hidden_keyframes()
        if hidden is not None and hidden[number]:
            self._put_off.append(number)
            submap = self._submaps.of_keyframe(number)
            same = [k for k in self._put_off if self._submaps.of_keyframe(k) == submap]
            return self._fetch(same) if len(same) >= _FETCHED else self._take_back()
        return [number, *self._take_back()]

    def put_off(self) -> list[int]:
        self._leave()
        return self._fetch(self._put_off[:1]) if self._put_off else []

    def _fetch(self, keyframes: list[int]) -> list[int]:
        """Bring what some that were put off see to memory; return all that are there then."""
        self._submaps.visit(sorted({*keyframes}))
        return self._take_back()

    def _take_back(self) -> list[int]:
        """Return what was put off and is in memory now, in the order in which it was drawn."""
        hidden = self._submaps.hidden_keyframes()
        away = np.zeros(self._count, bool) if hidden is None else hidden
        back = [k for k in self._put_off if not away[k]]
        self._put_off = [k for k in self._put_off if away[k]]
        return back

    def _leave(self) -> None:
        """Let go of what was fetched."""
        if self._submaps.visited:
            self._submaps.visit([])

    @property
    def window(self) -> list[int]:
        return [self._count - 1]

    def unconfirmed(self, keyframe_ids: Callable[[], NDArray[np.int32]]) -> Seen | None:
        return None


class WindowSampler(Stateful):
    """Rounds over the covisible window, the newest first, and two keyframes of the past (MonoGS)."""

    STATE = ("_rng", "_count", "_round", "_window")

    def __init__(
        self,
        rng: np.random.Generator,
        config: WindowConfig,
        look: Look,
        pose: Callable[[int], Float64],
        submaps: Submaps,
    ) -> None:
        """Start without keyframes.

        Args:
            look: what a pose sees of the map.
            pose: keyframe -> its camera-to-world [4, 4] as it is now.
            submaps: tells which keyframes are out of memory: they are left out.
        """
        self._rng = rng
        self._config = config
        self._look = look
        self._pose = pose
        self._submaps = submaps
        self._count = 0
        self._round: list[int] = []
        self._window: list[int] = []

    @property
    def window(self) -> list[int]:
        return self._window

    def add(self) -> None:
        self._window.append(self._count)
        self._count += 1
        self._round = []
        poses = [self._pose(k) for k in self._window]
        for i in reversed(keyframes_that_leave(poses, self._config, self._look)):
            del self._window[i]

    def add_earlier(self) -> None:
        self._count += 1

    def next(self) -> list[int]:
        if not self._round:
            hidden = self._submaps.hidden_keyframes()
            known = np.arange(self._count) if hidden is None else np.flatnonzero(~hidden)
            past = np.setdiff1d(known, self._window)
            some = self._rng.choice(past, min(_PAST, len(past)), replace=False)
            *others, newest = [number for number in self._window if number in known]
            self._round = [*self._rng.permutation([*others, *some]).astype(int).tolist(), newest]
        return [self._round.pop()]

    def put_off(self) -> list[int]:
        return []

    def unconfirmed(self, keyframe_ids: Callable[[], NDArray[np.int32]]) -> Seen | None:
        c = self._config
        if c.confirmations == 0 or len(self._window) < c.size:
            return None
        visible = {number: self._look(self._pose(number)).seen for number in self._window}
        return unconfirmed(keyframe_ids(), visible, c.confirmations)
