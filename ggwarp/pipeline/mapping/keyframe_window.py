# SPDX-License-Identifier: Apache-2.0
"""The sliding window: which keyframes are fitted together, and what they confirm (MonoGS)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.map.covisibility import Look, Seen, overlap_coefficient
from ggwarp.types import Float64

_RECENT = 3


@dataclass(frozen=True)
class WindowConfig:
    """Which keyframes are fitted together (MonoGS)."""

    size: int = 10
    """At most so many keyframes are fitted together."""
    confirmations: int = 0
    """A new Gaussian stays when at least that many other keyframes of a full window see it (MonoGS without
    depth: 3). With 0 all stay."""
    cutoff: float = 0.4
    """A keyframe leaves the window when it shares no more than this of its Gaussians with the newest (overlap
    coefficient)."""


def keyframes_that_leave(poses: list[Float64], config: WindowConfig, look: Look) -> list[int]:
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


def unconfirmed(keyframe_ids: NDArray[np.int32], visible: dict[int, Seen], confirmations: int) -> Seen:
    """Return [n] which Gaussians too few keyframes confirm, floaters of a guessed depth (MonoGS 3.3.3).

    Only those that the keyframes just before the newest one brought are looked at: older ones passed, and the
    newest's have not had their chance.

    Args:
        keyframe_ids: [n] number of the keyframe that brought each Gaussian.
        visible: keyframe of the window -> what it sees, [n].
        confirmations: keyframes other than its own that must see a Gaussian.
    """
    recent = sorted(visible)[-1 - _RECENT : -1]
    others = np.sum([seen & (keyframe_ids != number) for number, seen in visible.items()], axis=0)
    return np.isin(keyframe_ids, recent) & (others < confirmations)


def _crowding(i: int, window: list[int], centres: Float64) -> float:
    distances = np.linalg.norm(centres - centres[i], axis=1)
    nearness = sum(1.0 / (distances[j] + 1e-6) for j in window if j != i)
    return float(np.sqrt(distances[-1]) * nearness)
