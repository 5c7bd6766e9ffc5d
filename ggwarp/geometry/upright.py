# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a map that nobody levelled: from how the camera was held, and from flat surfaces.

Two things are known of any room. Cameras are held level: they seldom roll, and pitch less than they yaw. And
most of what is flat is horizontal or vertical. The first gives a rough direction, the second makes it exact
(S. Gupta, P. Arbelaez, J. Malik, "Perceptual Organization and Recognition of Indoor Scenes from RGB-D
Images", CVPR 2013, section 3). No truth is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ggwarp.geometry import se3
from ggwarp.types import Float64

Source = Literal["surfaces", "camera", "given"]

_ROLL, _PITCH = np.radians(5.0), np.radians(25.0)
"""Standard deviations of a hand-held camera's roll and pitch, radians."""
_HUBER = 2.0
"""Standard deviations beyond which a frame's pose counts by its distance, not its square."""
_TURNED = 4.0
"""How many times better a picture turned by 90 degrees must explain the poses to be taken for one."""
_PITCHES = np.radians([0.0, 20.0, 40.0, 60.0])
"""How far down cameras that all look the same way may be pitched: where the search begins."""
_USUAL_PITCH = np.radians(-15.0)
"""Of a hand-held camera: it looks down more than up."""
_REFINEMENTS = (np.radians(30.0),) * 5 + (np.radians(15.0),) * 5
"""Widths of the bands whose normals are taken for those of floors and walls, one a step."""
_SURFACE_WEIGHT = 20.0
"""Of the share of surface that a direction does not explain, beside the camera's squared deviations."""
_SUPPORT = 0.5
"""Least share of the surface in the last bands; by chance it is 0.29."""

CONVENTIONS: dict[str, Float64] = {
    "y-down": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "y-up": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
    "z-up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
"""Axes of other programs, as rows in those of a level camera (x right, y down, z forward): 3DGS and OpenCV,
glTF and most of graphics, ROS and most of CAD."""


@dataclass(frozen=True)
class Up:
    """The direction away from the floor.

    Attributes:
        direction: [3] unit vector, world frame.
        source: what it follows from.
        support: share of the flat surface that is horizontal or vertical by it, within 15 degrees; None: not
            asked.
    """

    direction: Float64
    source: Source
    support: float | None = None


def estimate_up(T_wc: Float64, normals: Float64, areas: Float64) -> Up:
    """Return the direction that is up.

    Args:
        T_wc: [n, 4, 4] camera-to-world poses, n > 0.
        normals: [m, 3] unit normals of surfaces, world frame, of either sign; there may be none.
        areas: [m] how much each counts, such as its area, m^2.
    """
    axes = np.moveaxis(np.asarray(T_wc, np.float64)[:, :3, :3], 2, 0)
    rough, right = _held_up(*axes)
    normals, areas = np.asarray(normals, np.float64), np.asarray(areas, np.float64)
    if not areas.sum() > 0.0:
        return Up(rough, "camera")
    # Rooms are boxes: which of their three axes is up, the camera says.
    middle = right[len(right) // 2]
    starts = [se3.so3_exp(-pitch * middle) @ rough for pitch in _PITCHES]
    found = [_refined(start, normals, areas) for start in starts]
    costs = [
        _cost(up, right, axes[2], _USUAL_PITCH) + _SURFACE_WEIGHT * (1.0 - support) for up, support in found
    ]
    up, support = found[int(np.argmin(costs))]
    return Up(up, "surfaces", support) if support >= _SUPPORT else Up(rough, "camera", support)


def given_up(direction: ArrayLike) -> Up:
    """Return the direction that a user gave, [3], of any length.

    Raises:
        ValueError: it has no direction.
    """
    vector = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not np.isfinite(vector).all() or length == 0.0:
        raise ValueError("up is three numbers that are not all zero")
    return Up(vector / length, "given")


def levelled(T_wc: Float64, up: Float64) -> Float64:
    """Return the pose [4, 4] that looks where ``T_wc`` does, with ``up`` [3] upwards in its picture."""
    forward = T_wc[:3, 2]
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:  # straight down or up: any roll is level
        return T_wc
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    out[:3, 3] = T_wc[:3, 3]
    return out


def rotation_to(convention: str, up: Float64, forward: Float64) -> Float64:
    """Return the rotation [3, 3] from the world to one of :data:`CONVENTIONS`.

    Args:
        up: [3] unit vector, world frame.
        forward: [3] what is to be ahead, world frame, but for its part along ``up``.
    """
    ahead = forward - (forward @ up) * up
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.eye(3)[np.abs(up).argmin()]
        ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    level = np.stack([np.cross(ahead, up), -up, ahead])  # rows: right, down, forward
    return CONVENTIONS[convention] @ level


def _held_up(x: Float64, y: Float64, z: Float64) -> tuple[Float64, Float64]:
    """Return what is up if cameras are held level, and which way is right in their pictures, [n, 3].

    A recording may be turned by 90 degrees, as telephones held upright make them; then its pictures' x axis
    is vertical.

    Args:
        x, y, z: [n, 3] the cameras' axes.
    """
    up = _level_direction(x, z)
    turned = _level_direction(y, z)
    if _cost(turned, y, z) * _TURNED < _cost(up, x, z):
        # Either side may be up; cameras look down more than up.
        turned = -turned if turned @ z.sum(axis=0) > 0.0 else turned
        return turned, y if turned @ x.sum(axis=0) > 0.0 else -y
    return (-up if up @ y.sum(axis=0) > 0.0 else up), x


def _level_direction(right: Float64, forward: Float64) -> Float64:
    """Return the direction [3] that leaves least roll and pitch, of either sign.

    Args:
        right, forward: [n, 3] the cameras' axes.
    """
    counts = np.ones(len(right))
    direction = np.zeros(3)
    for _ in range(10):
        roll = (right * counts[:, None]).T @ right / _ROLL**2
        pitch = (forward * counts[:, None]).T @ forward / _PITCH**2
        direction = np.linalg.eigh(roll + pitch)[1][:, 0]
        counts = _HUBER / np.maximum(_deviations(direction, right, forward), _HUBER)
    return direction


def _deviations(up: Float64, right: Float64, forward: Float64, pitch: float = 0.0) -> Float64:
    """Return [n] how many standard deviations cameras are from being held level, or at ``pitch`` radians."""
    return np.hypot(right @ up / _ROLL, (forward @ up - np.sin(pitch)) / _PITCH)


def _cost(up: Float64, right: Float64, forward: Float64, pitch: float = 0.0) -> float:
    """Return the mean square of the deviations, large ones by Huber's loss."""
    errors = _deviations(up, right, forward, pitch)
    return float(np.where(errors > _HUBER, 2.0 * _HUBER * errors - _HUBER**2, errors**2).mean())


def _refined(up: Float64, normals: Float64, areas: Float64) -> tuple[Float64, float]:
    """Return the direction near ``up`` by which most surface is level or upright, and that share of it."""
    for width in _REFINEMENTS:
        level, upright = _bands(normals, up, width)
        # min sum_walls (n . g)^2 + sum_floors |n x g|^2, over unit g
        moment = (normals * (areas * (upright.astype(float) - level))[:, None]).T @ normals
        found = np.linalg.eigh(moment)[1][:, 0]
        up = found * (np.sign(found @ up) or 1.0)
    level, upright = _bands(normals, up, _REFINEMENTS[-1])
    return up, float(areas[level | upright].sum() / areas.sum())


def _bands(normals: Float64, up: Float64, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return [m] which normals are of level surfaces and which of upright ones, within ``width`` radians."""
    along = np.abs(normals @ up)
    return along > np.cos(width), along < np.sin(width)
