# SPDX-License-Identifier: Apache-2.0
"""MonoGS's keyframes: chosen by covisibility, kept in a window, fitted together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.map.covisibility import Seen, Sight, intersection_over_union, overlap_coefficient
from ggwarp.pipeline.keyframes import KeyframeKind
from ggwarp.types import Float64, TrackResult, Verdict

_RECENT = 3

Look = Callable[[Float64], Sight]
"""What a camera-to-world pose [4, 4] sees of the map."""


@dataclass(frozen=True)
class WindowConfig:
    """When a frame becomes a keyframe by covisibility, and which keyframes are fitted together (MonoGS)."""

    interval: int = 4
    """A keyframe comes at least so many frames after the last one."""
    overlap: float = 0.95
    """A moved frame is a keyframe when what it sees and what the last one sees share less than this (IoU)."""
    min_translation: float = 0.02
    """Moved means farther than this share of the median depth."""
    translation: float = 0.04
    """Farther than this share of the median depth, a frame is a keyframe whatever it sees."""
    size: int = 10
    """Keyframes in the window."""
    confirmations: int = 0
    """Gaussians that the keyframes before the newest brought and that fewer others of a full window see are
    removed; MonoGS without depth: 3."""
    cutoff: float = 0.4
    """A keyframe leaves the window when it shares no more than this with the newest (overlap coefficient)."""


class CovisibilityKeyframes:
    """Decides by what frames see of the map (MonoGS section 3.3.1)."""

    needs_gaussians = True

    def __init__(self, config: WindowConfig, look: Look) -> None:
        self._config = config
        self._look = look
        self._last: Float64 | None = None
        self._since = 0

    @property
    def empty(self) -> bool:
        """Whether no frame has entered the map yet."""
        return self._last is None

    def decide(self, result: TrackResult) -> KeyframeKind:
        """Return what the frame behind ``result`` adds; call once a frame, in order."""
        self._since += 1
        if result.verdict is Verdict.LOST or not self._due(result.T_wc):
            return KeyframeKind.NONE
        self._last, self._since = result.T_wc, 0
        # Without depth there are no points to register to.
        return KeyframeKind.MAPPING if result.points is None else KeyframeKind.TRACKING

    def moved(self, T_wc: Float64) -> None:
        """Take note that the last keyframe's pose was corrected to ``T_wc`` [4, 4]."""
        self._last = T_wc

    def _due(self, T_wc: Float64) -> bool:
        c = self._config
        if self._last is None:
            return True
        if self._since < c.interval:
            return False
        here = self._look(T_wc)
        if not np.isfinite(here.median_depth):
            return True  # nothing of the map is in view
        distance = float(np.linalg.norm(T_wc[:3, 3] - self._last[:3, 3])) / here.median_depth
        if distance > c.translation:
            return True
        if distance <= c.min_translation:
            return False
        return intersection_over_union(here.seen, self._look(self._last).seen) < c.overlap


def leavers(poses: list[Float64], config: WindowConfig, look: Look) -> list[int]:
    """Return which keyframes leave the window.

    The newest two never do. Of the others, those that share too little with the newest leave; if the window
    is still too full, the one whose leaving spreads the rest best does: the largest sqrt(d_0) sum_j 1 / d_j,
    where d_0 is its distance to the newest and d_j to each of the others.

    Args:
        poses: camera-to-world [4, 4] of the window's keyframes, oldest first, the newest last.
    """
    *others, newest = poses
    candidates = range(len(others) - 1)
    seen = look(newest).seen
    gone = [i for i in candidates if overlap_coefficient(look(poses[i]).seen, seen) <= config.cutoff]
    rest = [i for i in candidates if i not in gone]
    if len(poses) - len(gone) > config.size and rest:
        centres = np.array([T[:3, 3] for T in poses])
        gone.append(max(rest, key=lambda i: _crowding(i, [*rest, len(others) - 1], centres)))
    return sorted(gone)


def unconfirmed(births: NDArray[np.int32], sights: dict[int, Seen], confirmations: int) -> Seen:
    """Return [n] which Gaussians too few keyframes confirm, floaters of a guessed depth (MonoGS 3.3.3).

    Only those that the keyframes just before the newest one brought are looked at: older ones passed, and the
    newest's have not had their chance.

    Args:
        births: [n] number of the keyframe that brought each Gaussian.
        sights: keyframe of the window -> what it sees, [n].
        confirmations: keyframes other than its own that must see a Gaussian.
    """
    recent = sorted(sights)[-1 - _RECENT : -1]
    others = np.sum([seen & (births != number) for number, seen in sights.items()], axis=0)
    return np.isin(births, recent) & (others < confirmations)


def _crowding(i: int, window: list[int], centres: Float64) -> float:
    distances = np.linalg.norm(centres - centres[i], axis=1)
    nearness = sum(1.0 / (distances[j] + 1e-6) for j in window if j != i)
    return float(np.sqrt(distances[-1]) * nearness)
