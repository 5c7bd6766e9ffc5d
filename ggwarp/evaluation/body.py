# SPDX-License-Identifier: Apache-2.0
"""Where a camera sits on the body whose poses are known: a marker, a robot, another sensor."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from ggwarp.types import Float64

_STEPS = (1, 5, 20)
"""Frames between two poses whose turns are compared."""


def camera_in_body(camera: Float64, body: Float64) -> Float64:
    """Return T_body_camera [4, 4] by which W body_i T_body_camera is nearest to camera_i, for some world W.

    First the turn, by what both turned from frame to frame (hand-eye calibration; Wahba's problem), then
    world and lever arm by least squares. About an axis that the camera never leaves, the turn is not told.

    Args:
        camera, body: [n, 4, 4] poses of the same frames in worlds of their own, metres, n >= 2.
    """
    steps = [step for step in _STEPS if step < len(camera)]
    turned, truly = (
        np.concatenate([_turns(poses[:, :3, :3], step) for step in steps]) for poses in (camera, body)
    )
    with warnings.catch_warnings():  # of turns that are all about one axis
        warnings.simplefilter("ignore")
        R_bc = Rotation.align_vectors(truly, turned)[0].as_matrix()
    R = body[:, :3, :3]
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", camera[:, :3, :3], R @ R_bc))
    world = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    left = camera[:, :3, 3] - body[:, :3, 3] @ world.T
    system = np.concatenate([world @ R, np.tile(np.eye(3), (len(R), 1, 1))], axis=2).reshape(-1, 6)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_bc, np.linalg.lstsq(system, left.ravel(), rcond=None)[0][:3]
    return T


def _turns(rotations: Float64, step: int) -> Float64:
    """Return the rotation vectors [n - step, 3] from each to that ``step`` frames on."""
    return Rotation.from_matrix(np.swapaxes(rotations[:-step], 1, 2) @ rotations[step:]).as_rotvec()
