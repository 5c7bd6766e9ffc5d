# SPDX-License-Identifier: Apache-2.0
"""Which keyframe the next mapping iteration is spent on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from ggwarp.map.covisibility import Look
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig, leavers
from ggwarp.types import Float64

_PAST = 2
"""Keyframes outside the window that each round takes in, so that the past is not forgotten (MonoGS)."""


class KeyframeSampler(Protocol):
    """Chooses keyframes, numbered in the order in which they came."""

    def add(self) -> None:
        """Take in the next keyframe."""
        ...

    def draw(self) -> int:
        """Return the keyframe to fit the map to; there must be one."""
        ...


class RandomSampler:
    """The newest keyframe first, once; then any, at random (GS-ICP-SLAM)."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._count = 0
        self._newest_pending = False

    def add(self) -> None:
        self._count += 1
        self._newest_pending = True

    def draw(self) -> int:
        if self._newest_pending:
            self._newest_pending = False
            return self._count - 1
        return int(self._rng.integers(self._count))


class WindowSampler:
    """Rounds over the covisible window, the newest first, and two keyframes of the past (MonoGS)."""

    def __init__(
        self, rng: np.random.Generator, config: WindowConfig, look: Look, pose: Callable[[int], Float64]
    ) -> None:
        """Start without keyframes.

        Args:
            look: what a pose sees of the map.
            pose: keyframe -> its camera-to-world [4, 4] as it is now.
        """
        self._rng = rng
        self.config = config
        self._look = look
        self._pose = pose
        self._count = 0
        self._round: list[int] = []
        self.window: list[int] = []

    def add(self) -> None:
        self.window.append(self._count)
        self._count += 1
        self._round = []
        for i in reversed(leavers([self._pose(k) for k in self.window], self.config, self._look)):
            del self.window[i]

    @property
    def full(self) -> bool:
        """Whether the window holds as many keyframes as it may."""
        return len(self.window) >= self.config.size

    def draw(self) -> int:
        if not self._round:
            past = np.setdiff1d(np.arange(self._count), self.window)
            some = self._rng.choice(past, min(_PAST, len(past)), replace=False)
            *others, newest = self.window
            self._round = [*self._rng.permutation([*others, *some]).astype(int).tolist(), newest]
        return self._round.pop()
