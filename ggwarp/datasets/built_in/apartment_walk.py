# SPDX-License-Identifier: Apache-2.0
"""The walk through the built-in apartment: one ring through all its rooms, and who else walks there."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from ggwarp.datasets.built_in.scene import looking
from ggwarp.types import Float64

AGAIN = 2.0
"""Of the way points from the start: the walk ends there, on its way of before."""

_EYE = 1.48
"""Height of the camera, metres."""
_STRIDE = 0.72
"""Length of a step, metres: the camera bobs once a step and sways once in two."""
_PACE = 0.55, np.radians(36.0)
"""Metres and radians a second that take the same time; the walk takes the hypotenuse of both."""
_DENSE = 6001

_WAY = (
    # x, y, heading (degrees from east over north), pitch (upwards)
    (2.76, 2.35, 180, -16),  # living room: the sofa
    (2.95, 2.24, 222, -15),
    (3.20, 2.30, 272, -14),  # the television
    (3.58, 2.34, 325, -16),
    (4.20, 2.20, 360, -14),
    (5.05, 2.05, 352, -16),  # kitchen
    (5.75, 1.75, 318, -18),
    (6.55, 1.60, 318, -20),
    (7.20, 1.75, 375, -16),
    (7.70, 2.35, 448, -14),
    (7.92, 3.20, 462, -14),
    (7.95, 4.05, 476, -14),  # corridor
    (7.75, 4.70, 522, -16),
    (7.10, 4.90, 542, -16),
    (6.30, 4.92, 535, -16),
    (5.72, 5.10, 490, -16),
    (5.45, 5.60, 455, -16),  # bedroom
    (5.42, 6.25, 425, -18),
    (5.42, 6.90, 398, -18),
    (5.38, 7.50, 425, -16),
    (5.10, 7.95, 495, -16),
    (4.60, 8.05, 535, -16),
    (4.05, 8.05, 542, -16),  # study
    (3.45, 7.90, 540, -18),
    (2.90, 7.55, 500, -18),
    (2.30, 7.30, 520, -16),
    (1.70, 7.10, 580, -16),
    (1.20, 6.65, 622, -16),
    (0.97, 6.00, 632, -14),
    (0.97, 5.35, 658, -16),  # corridor
    (1.22, 4.98, 702, -16),
    (1.75, 4.88, 716, -16),
    (2.28, 4.72, 690, -16),
    (2.58, 4.30, 648, -14),
    (2.66, 3.75, 630, -14),  # living room
    (2.68, 3.15, 606, -16),
    (2.68, 2.65, 574, -17),
)

_WALKS = (
    # time (way points), x, y: north out of the living room; in by the front door; along the study
    ((0.0, 2.02, 0.90), (1.0, 2.05, 2.10), (1.8, 2.45, 3.40), (2.3, 2.65, 4.30)),
    ((12.0, 0.70, 4.90), (13.0, 2.00, 4.90), (13.5, 2.62, 4.60), (14.2, 2.65, 3.40)),
    ((22.2, 0.95, 5.70), (23.6, 0.95, 7.20), (24.6, 1.30, 8.30)),
)


def apartment_trajectory(frames: int) -> Float64:
    """Return [frames, 4, 4] camera-to-world poses: once around, and on to where it has been before.

    With 2,400 frames at 30 a second the camera walks 0.3 m and turns 17 degrees a second, and at most
    0.42 m and 27 degrees.
    """
    return np.stack([_pose(t) for t in way_points(frames)])


def way_points(frames: int) -> Float64:
    """Return the place of each frame along the way, [frames], counted in way points."""
    times, distance = _walked()
    turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(_heading(times))))])
    spent = np.concatenate(
        [[0.0], np.cumsum(np.hypot(np.diff(distance) / _PACE[0], np.diff(turned) / _PACE[1]))]
    )
    return np.interp(np.linspace(0.0, spent[-1], frames), spent, times)


def person_at(time: float) -> tuple[Float64, float, float] | None:
    """Return where another person is at ``time`` way points: [2] metres, heading, metres walked; or None."""
    for walk in _WALKS:
        if walk[0][0] <= time <= walk[-1][0]:
            knots = np.array(walk)
            legs = np.linalg.norm(np.diff(knots[:, 1:], axis=0), axis=1)
            along = PchipInterpolator(knots[:, 0], np.concatenate([[0.0], np.cumsum(legs)]))
            path = PchipInterpolator(knots[:, 0], knots[:, 1:])
            ahead = path(min(time + 0.05, knots[-1, 0])) - path(max(time - 0.05, knots[0, 0]))
            return path(time), float(np.arctan2(ahead[1], ahead[0])), float(along(time))
    return None


def _round(times: Any) -> Any:
    return np.mod(times, len(_WAY))


@lru_cache(maxsize=1)
def _splines() -> tuple[CubicSpline, CubicSpline]:
    """Return x, y over way points, and what heading and pitch add to one even turn; both periodic."""
    way = np.array([*_WAY, _WAY[0]], np.float64)
    way[-1, 2] += 360.0
    knots = np.arange(len(way), dtype=np.float64)
    angles = np.radians(np.stack([way[:, 2] - 360.0 * knots / knots[-1], way[:, 3]], axis=1))
    return CubicSpline(knots, way[:, :2], bc_type="periodic"), CubicSpline(knots, angles, bc_type="periodic")


@lru_cache(maxsize=1)
def _walked() -> tuple[Float64, Float64]:
    """Return way points [n], densely, and the metres walked until each."""
    times = np.linspace(0.0, len(_WAY) + AGAIN, _DENSE)
    steps = np.linalg.norm(np.diff(_splines()[0](_round(times)), axis=0), axis=1)
    return times, np.concatenate([[0.0], np.cumsum(steps)])


def _heading(times: Any) -> Any:
    return _splines()[1](_round(times))[..., 0] + 2.0 * np.pi * times / len(_WAY)


def _pose(time: float) -> Float64:
    """Camera-to-world at ``time`` way points: carried by hand, at a walk."""
    position, angles = _splines()
    step = np.pi * np.interp(time, *_walked()) / _STRIDE
    heading = _heading(time) + np.radians(0.7) * np.sin(step + 1.0)
    pitch = angles(_round(time))[1] + np.radians(0.6) * np.sin(2.0 * step + 0.6)
    T_wc = np.eye(4)
    T_wc[:3, :3] = looking(heading, pitch, np.radians(0.8) * np.sin(step))
    T_wc[:3, 3] = *position(_round(time)), _EYE + 0.015 * np.sin(2.0 * step)
    return T_wc
