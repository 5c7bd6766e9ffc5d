# SPDX-License-Identifier: Apache-2.0
"""What of a picture contradicts the rest of the recording, so that it is not baked into the map.

- *Pixels that moved.* A keyframe sees through a point of another where its depth lies behind it: the point
  was not there at that time. Keyframes vote on each other's pixels; those that more saw through than found in
  place show something that moves, as a person who walks by. One vote proves nothing: depth may be wrong.
- *Pictures* of which half the pixels that the map explains are clipped where it is not, or of other colours
  whatever the exposure: no robust estimate holds beyond a half. Single clipped pixels count: what is white or
  black may be so, and the map not yet.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float32, Float64, Frame, Rendered

Bools = NDArray[np.bool_]

_RECENT = 8
"""Keyframes that vote on each other: what stands still for longer is furniture."""
_STRIDE = 2
"""Every second pixel votes for its neighbours, too."""
_TOLERANCE = 0.05
"""Surfaces whose depths differ by less than this share may be one: three standard deviations of a Kinect at
4 m (Nguyen et al., 2012), and a pose that is a little off."""
_LEAST_VOTES = 2
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_DARK, _BRIGHT = 4.0 / 255.0, 250.0 / 255.0
_APART = 0.1
"""A clipped pixel is wrong where the map is this far from the end of the scale."""
_DIFFERENT = 0.2
"""Of the scale, in a channel: colours this far apart are not those of one place in one light."""
_OPAQUE = 0.95
_BREAKDOWN = 0.5
_LEAST = 0.05
"""Share of a picture that the map must explain before it can be contradicted."""


def clipped_share(frame: Frame, rendered: Rendered) -> float:
    """Return the share of what the map explains of a picture that is clipped there, and not in the map.

    Args:
        frame: at the map's image size, with depth.
        rendered: the map's view from its pose.
    """
    picture, explained = frame.rgb.astype(np.float32) / 255.0, _explained(frame, rendered)
    if np.mean(explained) < _LEAST:
        return 0.0
    white = np.any((picture >= _BRIGHT) & (rendered.rgb < _BRIGHT - _APART), axis=2)
    black = np.all((picture <= _DARK) & (rendered.rgb > _DARK + _APART), axis=2)
    return np.count_nonzero(explained & np.logical_or(white, black)) / np.count_nonzero(explained)


def different_share(frame: Frame, rendered: Rendered) -> float:
    """Return the share of what the map explains of a picture that has other colours, at its best exposure.

    Gain and offset of each channel are those of medians and median deviations, which half of the pixels
    cannot move; or none, where the map's own exposure fits better.

    Args:
        frame, rendered: as of :func:`clipped_share`.
    """
    picture, explained = frame.rgb.astype(np.float32) / 255.0, _explained(frame, rendered)
    if np.mean(explained) < _LEAST:
        return 0.0
    seen, known = picture[explained], rendered.rgb[explained]
    middle, known_middle = np.median(seen, axis=0), np.median(known, axis=0)
    spread, known_spread = (
        np.median(np.abs(values - centre), axis=0)
        for values, centre in ((seen, middle), (known, known_middle))
    )
    exposed = (known - known_middle) * (spread / np.maximum(known_spread, 1e-3)) + middle
    shares = [np.mean(np.any(np.abs(seen - colours) > _DIFFERENT, axis=1)) for colours in (known, exposed)]
    return float(min(shares))


def unusable(frame: Frame, rendered: Rendered) -> str:
    """Say why a picture is left out whole, having been compared with the map's view; empty: it is used."""
    for share, said in (
        (clipped_share(frame, rendered), "is clipped"),
        (different_share(frame, rendered), "has other colours"),
    ):
        if share > _BREAKDOWN:
            return f"{100.0 * share:.0f} % of what the map knows of it {said}"
    return ""


def _explained(frame: Frame, rendered: Rendered) -> Bools:
    """Return [h, w] where the map is opaque and where the depth says it is."""
    assert frame.depth is not None
    there = (rendered.opacity > _OPAQUE) & (frame.depth > 0.0)
    return there & (np.abs(rendered.surface_depth - frame.depth) < _TOLERANCE * frame.depth)


@state_value
@dataclass
class _Voter:
    """A recent keyframe: its number, pose, depth at every second pixel, and the votes on each."""

    number: int
    T_wc: Float64
    points: Float32
    depth: Float32
    nearest: Float32
    through: NDArray[np.int16]
    in_place: NDArray[np.int16]

    def moved(self) -> Bools:
        return (self.through >= _LEAST_VOTES) & (self.through > self.in_place)


class MovingPixels(Stateful):
    """Finds the pixels of keyframes that show what moves.

    Attributes:
        camera: of the keyframes' depth.
    """

    STATE = ("_recent",)

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._recent: deque[_Voter] = deque(maxlen=_RECENT)

    def add(self, number: int, depth: Float32, T_wc: Float64) -> dict[int, Bools]:
        """Let a new keyframe and the recent ones vote on each other.

        Args:
            number: its number.
            depth: [h, w] metres, 0 = none.
            T_wc: [4, 4] its pose.

        Returns:
            Number -> [h, w] the pixels that moved, of it and of those of the recent that have any.
        """
        voter = self._voter(number, depth, T_wc)
        for other in self._recent:
            self._vote(other, voter)
            self._vote(voter, other)
        self._recent.append(voter)
        masks = {v.number: _whole(v.moved(), depth.shape) for v in self._recent}
        return {number: mask for number, mask in masks.items() if mask.any()}

    def move(self, motions: Float64) -> None:
        """Let the recent keyframes follow a correction: ``motions`` [n, 4, 4] of the world, by number."""
        for voter in self._recent:
            voter.T_wc = motions[voter.number] @ voter.T_wc

    def _voter(self, number: int, depth: Float32, T_wc: Float64) -> _Voter:
        depth = np.where(np.isfinite(depth), depth, np.float32(0))
        h, w = depth.shape
        rows, columns = np.mgrid[0:h:_STRIDE, 0:w:_STRIDE]
        few = np.ascontiguousarray(depth[::_STRIDE, ::_STRIDE])
        # The nearest of the neighbours: 0, no evidence, where any has no depth.
        nearest = np.asarray(cv2.erode(few, _NEIGHBOURS), np.float32)
        points = self.camera.back_project(columns, rows, few).astype(np.float32)
        votes = np.zeros(few.shape, np.int16)
        return _Voter(number, T_wc, points, few, nearest, votes, votes.copy())

    def _vote(self, subject: _Voter, witness: _Voter) -> None:
        """Count where ``witness`` sees through the points of ``subject``, and where they are in place."""
        T = (se3.inverse(witness.T_wc) @ subject.T_wc).astype(np.float32)
        points = subject.points @ T[:3, :3].T + T[:3, 3]
        rows, columns, inside = self.camera.pixels_of(points)
        rows, columns = rows // _STRIDE, columns // _STRIDE
        known = inside & (subject.depth > 0.0)
        z = points[..., 2]
        subject.through += known & (witness.nearest[rows, columns] > z * (1.0 + _TOLERANCE))
        subject.in_place += known & (np.abs(witness.depth[rows, columns] - z) < _TOLERANCE * z)


def _whole(moved: Bools, shape: tuple[int, ...]) -> Bools:
    """Return the mask of every second pixel [h, w] at full ``shape``, without specks and with a rim."""
    if not moved.any():
        return np.zeros(shape, bool)
    solid = cv2.morphologyEx(moved.astype(np.uint8), cv2.MORPH_OPEN, _NEIGHBOURS)
    solid = cv2.dilate(solid, _NEIGHBOURS)
    return np.asarray(cv2.resize(solid, shape[::-1], interpolation=cv2.INTER_NEAREST), bool)


def without_pixels(frame: Frame, where: Bools) -> Frame:
    """Return ``frame`` without depth at ``where`` [h, w]: there it neither seeds nor binds the map."""
    assert frame.depth is not None
    return replace(frame, depth=np.where(where, np.float32(0), frame.depth)) if where.any() else frame
