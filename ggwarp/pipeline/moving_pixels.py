# SPDX-License-Identifier: Apache-2.0
"""Pixels that show something that moves, found by free space.

A view sees through a point of another where its depth lies behind it: the point was not there at that time.
Views vote on each other's pixels; those that more saw through than found in place show something that moves,
as a person who walks by. One vote proves nothing: depth may be wrong.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.registration.free_space import IN_PLACE, THROUGH, cast_votes
from ggwarp.runtime.scratch import ScratchArrays
from ggwarp.runtime.state import FrameSource, State, Stateful, state_value
from ggwarp.runtime.streams import to_host
from ggwarp.types import Float32, Float64, Frame

Bools = NDArray[np.bool_]

_RECENT = 8
"""Views that vote on each other: what stands still for longer is furniture."""
_STRIDE = 2
"""Every second pixel of a row and column votes, for its neighbours, too..."""
_VOTES = 25_000
"""... and of a large picture fewer, about so many in all: what moves is no smaller than in a small one."""
_TOLERANCE = 0.05
"""Surfaces whose depths differ by less than this share may be one: three standard deviations of a Kinect at
4 m (Nguyen et al., 2012), and a pose that is a little off."""
_LEAST_VOTES = 2
_SAME_SIDE = 0.0
"""Cosine of the angle between two views' axes below which they are not compared: they show other sides."""
_AGES = 8
"""Of the frames that testify to free space: up to 2^8 frames."""
_AT_ONCE = 32
"""Views of an earlier map that are looked at in one go: what bounds the memory."""
_NEIGHBOURS = np.ones((3, 3), np.uint8)


@state_value
@dataclass
class _Voter:
    """A recent view: its number, pose, depth at the pixels that vote, and the votes on each."""

    number: int
    T_wc: Float64
    depth: Float32
    nearest: Float32
    through: NDArray[np.int16]
    in_place: NDArray[np.int16]

    def moved(self) -> Bools:
        return (self.through >= _LEAST_VOTES) & (self.through > self.in_place)


class _Ballot:
    """Asks what views of ``camera`` say of each other's points, on ``device``, where it keeps their depth."""

    def __init__(self, camera: Camera, device: Any) -> None:
        self._camera, self._device = camera, device
        self._stride = _stride(camera.height, camera.width)
        self._scratch = ScratchArrays(device)
        self._kept: list[_Voter | None] = []  # by their place in the arrays of depth

    def ask(self, pairs: Sequence[tuple[_Voter, _Voter]]) -> NDArray[np.uint8]:
        """Return [p, h, w] what is said of each subject's pixels by its witness, for (subject, witness).

        Two calls' answers are in the same memory.
        """
        voters = {id(voter): voter for pair in pairs for voter in pair}
        depth, nearest = self._on_device(list(voters.values()))
        places = {id(voter): place for place, voter in enumerate(self._kept)}
        who = np.array([(places[id(subject)], places[id(witness)]) for subject, witness in pairs], np.int32)
        subjects, witnesses = (np.stack([voter.T_wc for voter in side]) for side in zip(*pairs, strict=True))
        motions = (np.linalg.inv(witnesses) @ subjects).astype(np.float32)
        said = self._scratch.take("said", (len(pairs), *depth.shape[1:]), wp.uint8)
        cast_votes(
            depth,
            nearest,
            self._scratch.upload("who", who, wp.int32),
            self._scratch.upload("motions", motions, wp.float32),
            intrinsics_of(self._camera),
            stride=self._stride,
            tolerance=_TOLERANCE,
            said=said,
            device=self._device,
        )
        return to_host(said)

    def vote(self, pairs: Sequence[tuple[_Voter, _Voter]]) -> None:
        """Count for each (subject, witness) where the witness sees through its points, or finds them."""
        if not pairs:
            return
        for (subject, _), word in zip(pairs, self.ask(pairs), strict=True):
            subject.through += word == THROUGH
            subject.in_place += word == IN_PLACE

    def _on_device(self, voters: list[_Voter]) -> tuple[Any, Any]:
        """Return the depth and the nearest depth [k, h, w] of views that are kept, ``voters`` among them."""
        asked, kept = {id(voter) for voter in voters}, {id(voter) for voter in self._kept}
        new = [voter for voter in voters if id(voter) not in kept]
        free = [place for place, voter in enumerate(self._kept) if id(voter) not in asked]
        if len(new) > len(free):
            new, free = voters, list(range(len(voters)))
            self._kept = [*voters, *(None for _ in voters)]
        shape = len(self._kept), *voters[0].depth.shape
        depth, nearest = (self._scratch.take(name, shape, wp.float32) for name in ("depth", "nearest"))
        for place, voter in zip(free, new, strict=False):
            depth[place].assign(voter.depth)
            nearest[place].assign(voter.nearest)
            self._kept[place] = voter
        return depth, nearest


class MovingPixels(Stateful):
    """Finds the pixels of views that show what moves."""

    STATE = ("_recent",)

    def __init__(self, camera: Camera, *, device: Any = "cpu") -> None:
        """Know no view yet; their depth is by ``camera``, and compared on ``device``."""
        self._ballot = _Ballot(camera, device)
        self._recent: deque[_Voter] = deque(maxlen=_RECENT)

    def add(self, number: int, depth: Float32, T_wc: Float64) -> dict[int, Bools]:
        """Let a new view and the recent ones vote on each other.

        Args:
            number: its number.
            depth: [h, w] metres, 0 = none.
            T_wc: [4, 4] its pose.

        Returns:
            Number -> [h, w] the pixels that moved, of it and of those of the recent that have any.
        """
        voter = _voter(number, depth, T_wc)
        both_ways = [pair for other in self._recent for pair in ((other, voter), (voter, other))]
        self._ballot.vote(both_ways)
        self._recent.append(voter)
        masks = {v.number: _whole(v.moved(), depth.shape) for v in self._recent}
        return {number: mask for number, mask in masks.items() if mask is not None}

    def move(self, motion_of: Callable[[int], Float64]) -> None:
        """Let the recent views follow a correction: the motion [4, 4] of the world, by a view's number."""
        for voter in self._recent:
            voter.T_wc = motion_of(voter.number) @ voter.T_wc


class GonePixels(Stateful):
    """Finds the pixels of older views that new ones see through: what was there has been taken away."""

    def __init__(self, camera: Camera, *, device: Any = "cpu") -> None:
        """Know no view yet; all are ``camera``'s."""
        self._ballot = _Ballot(camera, device)
        self._views: list[_Voter] = []

    def begin(self, number: int, depth: Float32, T_wc: Float64) -> None:
        """Take in an older view, its number, depth [h, w], metres, 0 = none, and pose [4, 4]."""
        self._views.append(_voter(number, depth, T_wc))

    def add(self, depth: Float32, T_wc: Float64) -> dict[int, Bools]:
        """Let a new view, ``depth`` [h, w] from ``T_wc`` [4, 4], vote on the older ones.

        Returns:
            Number -> [h, w] the pixels that are gone, of those older ones where any are by this vote.
        """
        changed = dict[int, Bools]()
        if not self._views:
            return changed
        witness = _voter(-1, depth, T_wc)
        views = [view for view in self._views if view.T_wc[:3, 2] @ T_wc[:3, 2] >= _SAME_SIDE]
        before = [view.moved() for view in views]
        for some in range(0, len(views), _AT_ONCE):
            self._ballot.vote([(view, witness) for view in views[some : some + _AT_ONCE]])
        for view, moved in zip(views, before, strict=True):
            now = view.moved()
            if (now & ~moved).any() and (pixels := _whole(now, depth.shape)) is not None:
                changed[view.number] = pixels
        return changed

    def state(self) -> State:
        """Return the votes alone: the views are had again."""
        return {
            "through": [v.through.copy() for v in self._views],
            "in_place": [v.in_place.copy() for v in self._views],
        }

    def restore(self, state: State, frames: FrameSource) -> None:
        """Take over the votes on the same views."""
        for view, through, in_place in zip(self._views, state["through"], state["in_place"], strict=True):
            view.through, view.in_place = through.copy(), in_place.copy()


class FreeSpace(Stateful):
    """Where the camera has lately seen that nothing is, so that a frame's pixels there show what moves.

    Frames testify at ages that double: 1, 2, 4 ... frames. The young ones know what has just come into view,
    the old ones what has stood in the way since; what stands for longer than the oldest is furniture.
    """

    STATE = ("_witnesses", "_added")

    def __init__(self, camera: Camera, *, device: Any = "cpu") -> None:
        """Know nothing yet; frames' depth is by ``camera``."""
        self._ballot = _Ballot(camera, device)
        self._witnesses: list[_Voter] = []
        self._added = 0
        self._looked: tuple[Float32, _Voter] | None = None  # the depth that was looked at last, as a view

    def seen_through(self, depth: Float32, T_wc: Float64) -> Bools:
        """Return the pixels [h, w] that lie in front of what any earlier frame saw there.

        One vote is enough: a reading that is left out by mistake costs a pose nothing.

        Args:
            depth: [h, w] metres, 0 = none.
            T_wc: [4, 4] its pose.
        """
        if self._looked is None or self._looked[0] is not depth:
            self._looked = depth, _voter(self._added, depth, T_wc)
        view = self._looked[1]
        view.T_wc = T_wc
        if not self._witnesses:
            return np.zeros(depth.shape, bool)
        said = self._ballot.ask([(view, witness) for witness in self._witnesses])
        moved = _whole((said == THROUGH).any(axis=0), depth.shape)
        return np.zeros(depth.shape, bool) if moved is None else moved

    def add(self, depth: Float32, T_wc: Float64) -> None:
        """Let the last frame, ``depth`` [h, w] from ``T_wc`` [4, 4], testify from now on."""
        looked, self._looked = self._looked, None
        if looked is not None and looked[0] is depth:
            witness = looked[1]
            witness.T_wc = T_wc
        else:
            witness = _voter(self._added, depth, T_wc)
        self._witnesses.append(witness)
        self._added += 1
        # Of 2^k frames between ages 2^k and 2^(k + 1) one number is a multiple of 2^k.
        ages = [(w, (self._added - w.number).bit_length() - 1) for w in self._witnesses]
        self._witnesses = [w for w, k in ages if k < _AGES and w.number % 2**k == 0]

    def move(self, motion: Float64) -> None:
        """Follow the frames, which a closed loop has moved by ``motion`` [4, 4] of the world."""
        for witness in self._witnesses:
            witness.T_wc = motion @ witness.T_wc


def _voter(number: int, depth: Float32, T_wc: Float64) -> _Voter:
    stride = _stride(*depth.shape)
    few = np.ascontiguousarray(depth[::stride, ::stride])
    few = np.where(np.isfinite(few), few, np.float32(0))
    # The nearest of the neighbours: 0, no evidence, where any has no depth.
    nearest = np.asarray(cv2.erode(few, _NEIGHBOURS), np.float32)
    votes = np.zeros(few.shape, np.int16)
    return _Voter(number, T_wc, few, nearest, votes, votes.copy())


def _stride(height: int, width: int) -> int:
    return max(_STRIDE, round((height * width / _VOTES) ** 0.5))


def _whole(moved: Bools, shape: tuple[int, ...]) -> Bools | None:
    """Return the mask of the pixels that vote [h, w] at full ``shape``, without specks and with a rim.

    None: there are none but specks.
    """
    if not moved.any():
        return None
    solid = cv2.morphologyEx(moved.view(np.uint8), cv2.MORPH_OPEN, _NEIGHBOURS)
    if not solid.any():
        return None
    solid = cv2.dilate(solid, _NEIGHBOURS)
    return np.asarray(cv2.resize(solid, shape[::-1], interpolation=cv2.INTER_NEAREST)).view(bool)


def without_pixels(frame: Frame, where: Bools) -> Frame:
    """Return ``frame`` without depth at ``where`` [h, w]: there it neither seeds, binds nor is registered."""
    assert frame.depth is not None
    if not where.any():
        return frame
    sensor_depth = frame.sensor_depth
    if sensor_depth is not None:
        size = sensor_depth.shape[::-1]
        there = cv2.resize(where.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        sensor_depth = np.where(there > 0, np.float32(0), sensor_depth)
    depth = np.where(where, np.float32(0), frame.depth)
    return replace(frame, depth=depth, sensor_depth=sensor_depth)
