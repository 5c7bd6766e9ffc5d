# SPDX-License-Identifier: Apache-2.0
"""What makes a truth disagree with an estimate though both are right: other units, other axes, another frame.

Each hypothesis changes the true poses as if they had been written by another convention. It explains the
disagreement where the changed truth agrees with the estimate several times better, in places and in turns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ggwarp.evaluation.body import camera_in_body
from ggwarp.evaluation.trajectory import absolute_error, align
from ggwarp.geometry import se3
from ggwarp.types import Float64

_FEWEST = 5
"""Poses that say something."""
_SURE = 4.0
"""How many times better a hypothesis must agree, places and turns multiplied."""
_SAME_PLACE, _SAME_TURN = 0.003, math.radians(0.2)
"""Agreement that is not worth improving: of places as a share of the path, of turns in radians."""
_SCALES = {
    1000.0: "millimetres",
    100.0: "centimetres",
    0.3048: "feet",
}
_FREE_TURN = math.radians(5.0)
"""Of a camera in a hand; all true rotations being one is no truth then."""
_FARTHEST_SHIFT = 30
"""Frames by which a truth is looked for earlier and later."""
_SIMPLER = 1.5
"""How many times better a fitted offset must be than a convention that needs no fit."""
_LEAST_TURN, _LEAST_ARM = math.radians(5.0), 0.03
"""Radians and metres: of a body that is another one than the camera; less is how well it was calibrated."""
_ROS = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Turns a camera's axes to those of ROS's bodies."""
_LEAST_SCALE = 1.1
"""Estimates of RGB-D agree in scale to a few per cent."""
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Agreement:
    """How far an estimate is from a truth.

    Attributes:
        place: root mean square distance after rigid alignment, as a share of the true path's length.
        turn: root mean square angle between the rotations, after the best turn of the world, radians.
    """

    place: float
    turn: float

    def better_than(self, other: Agreement) -> float:
        """Return how many times better this one is, places and turns multiplied."""
        place = max(other.place, _SAME_PLACE) / max(self.place, _SAME_PLACE)
        turn = max(other.turn, _SAME_TURN) / max(self.turn, _SAME_TURN)
        return place * turn if min(place, turn) > 0.8 else 0.0


def doubt_of_truth(estimated: Float64, true: Float64) -> str:
    """Say which convention explains why a truth disagrees with an estimate; empty: none does, or it agrees.

    Args:
        estimated, true: [n, 4, 4] camera-to-world poses of the same frames, metres; no estimate is a mere
            prediction.
    """
    if len(true) < _FEWEST or _path(estimated) <= 0.0 or _path(true) <= 0.0:
        return ""
    if scale := _scale(estimated, true):
        return scale
    if _turns(true) < _SAME_TURN < _FREE_TURN < _turns(estimated):
        return (
            "the true rotations are all the same: are they positions alone? Errors of turns say nothing then"
        )
    best, reason = 1.0, ""
    for said, change in _hypotheses():
        gain = _agreement(estimated, change(true)).better_than(_agreement(estimated, true))
        if gain > best:
            best, reason = gain, said
    for shift in range(-_FARTHEST_SHIFT, _FARTHEST_SHIFT + 1):
        if not shift or len(true) - abs(shift) < max(_FEWEST, len(true) // 2):
            continue
        kept = slice(max(0, -shift), len(true) - max(0, shift))
        moved = slice(max(0, shift), len(true) + min(0, shift))
        own = _agreement(estimated[kept], true[kept])
        gain = _agreement(estimated[kept], true[moved]).better_than(own)
        if gain > best:
            frames = f"{abs(shift)} frame{'s' * (abs(shift) > 1)}"
            best, reason = gain, f"if they are {frames} {'early' if shift > 0 else 'late'}"
    offset = camera_in_body(estimated, true)
    gain = _agreement(estimated, true @ offset).better_than(_agreement(estimated, true))
    if gain > _SIMPLER * best and (said := _body(offset)):
        best, reason = gain, said
    return f"the true poses fit the estimated ones {best:.0f} times better {reason}" if best >= _SURE else ""


def _hypotheses() -> Iterator[tuple[str, Callable[[Float64], Float64]]]:
    """Yield what is said of each, and how it changes the true poses."""
    yield "if their cameras have OpenGL's axes (y up, z back): turn them by 180 degrees about x", _opengl
    yield "if they are world-to-camera: invert them", _inverse
    yield "if they are world-to-camera with OpenGL's axes", lambda true: _inverse(_OPENGL @ true)
    yield "if their quaternions are written w first", _w_first
    yield "if their rotations are transposed", _transposed
    yield "if they are in reverse order", lambda true: true[::-1]
    for axis, name in enumerate("xyz"):
        mirror = np.diag([-1.0 if i == axis else 1.0 for i in range(4)])
        unity = " (Unity's)" if name == "y" else ""
        yield f"if they are left-handed{unity}: mirror {name}", lambda true, m=mirror: m @ true @ m


def _body(T_body_camera: Float64) -> str:
    """Say what body the true poses are of, where the camera is fixed to it; empty: to the camera itself."""
    if math.acos(min(1.0, 0.5 * (float(np.trace(_ROS.T @ T_body_camera[:3, :3])) - 1.0))) < _LEAST_TURN:
        return "if they are of a body with ROS's axes (x forward, z up)"
    turn, arm = se3.so3_log(T_body_camera[:3, :3]), float(np.linalg.norm(T_body_camera[:3, 3]))
    parts = []
    if (angle := float(np.linalg.norm(turn))) > _LEAST_TURN:
        axis = " ".join(f"{value:g}" for value in np.round(turn / angle, 2) + 0.0)
        parts.append(f"turned by {math.degrees(angle):.0f} degrees about ({axis})")
    if arm > _LEAST_ARM:
        parts.append(f"{100.0 * arm:.0f} cm away")
    return f"if they are of a body that is {' and '.join(parts)} from the camera" if parts else ""


def _turns(poses: Float64) -> float:
    """Return the largest angle between the first pose's rotation and another's, radians."""
    cosine = 0.5 * (np.einsum("ij,nij->n", poses[0, :3, :3], poses[:, :3, :3]) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)).max())


def _scale(estimated: Float64, true: Float64) -> str:
    """Say so where one trajectory is the other one at another scale."""
    source, target = estimated[:, :3, 3], true[:, :3, 3]
    scale, R, t = align(source, target, with_scale=True)
    if scale <= 0.0 or max(scale, 1.0 / scale) < _LEAST_SCALE:
        return ""
    left = math.sqrt(float(np.mean(np.sum((target - (scale * source @ R.T + t)) ** 2, axis=1)))) / _path(true)
    rigid = absolute_error(estimated, true).rmse / _path(true)
    if max(rigid, _SAME_PLACE) < _SURE * max(left, _SAME_PLACE):
        return ""
    unit = next((name for ratio, name in _SCALES.items() if abs(scale / ratio - 1.0) < 0.05), "")
    reason = f"are the true poses in {unit}, or is" if unit else "is"
    return (
        f"the true trajectory is {scale:.3g} times as long as the estimated one and else agrees: {reason} "
        "the depth's scale another one?"
    )


def _path(poses: Float64) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def _agreement(estimated: Float64, true: Float64) -> Agreement:
    turned, truly = estimated[:, :3, :3], true[:, :3, :3]
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", truly, turned))
    world = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    cosine = 0.5 * (np.einsum("nij,nij->n", world @ turned, truly) - 1.0)
    angles = np.arccos(np.clip(cosine, -1.0, 1.0))
    path = max(_path(true), 1e-9)
    return Agreement(absolute_error(estimated, true).rmse / path, math.sqrt(float(np.mean(angles**2))))


def _opengl(true: Float64) -> Float64:
    return true @ _OPENGL


def _inverse(true: Float64) -> Float64:
    return np.asarray(np.linalg.inv(true), np.float64)


def _transposed(true: Float64) -> Float64:
    out = true.copy()
    out[:, :3, :3] = np.swapaxes(true[:, :3, :3], 1, 2)
    return out


def _w_first(true: Float64) -> Float64:
    """Return poses whose quaternions, read as x y z w, are taken for w x y z."""
    out = true.copy()
    for pose in out:
        w, x, y, z = se3.quat_from_matrix(pose[:3, :3])
        pose[:3, :3] = se3.matrix_from_quat([x, y, z, w])
    return out
