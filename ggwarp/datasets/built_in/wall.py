# SPDX-License-Identifier: Apache-2.0
"""The built-in wall: one plane with a rich print and nothing else, which geometry cannot hold.

Points on a plane slide along it freely: registration of depth alone knows the distance and the tilt, but not
where along the wall the camera is. Colour does.

World frame as in the office: z up, x to the east, y to the north, where the wall is.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ggwarp.datasets.built_in.office import HEIGHT, LENGTH, ROOM, WIDTH
from ggwarp.datasets.built_in.scene import Material, Scene, SceneBuilder, looking
from ggwarp.kernels.scene import procedural as patterns
from ggwarp.types import Float64

_DISTANCE = 1.1
"""Of the camera from the wall, metres."""


@lru_cache(maxsize=1)
def wall_scene() -> Scene:
    """Return the wall in the office's light: an object, not a structure of a room."""
    s = SceneBuilder()
    paint = Material((0.88, 0.74, 0.56), (0.30, 0.42, 0.52), patterns.POSTER, 0.22)
    with s.object("wall"):
        s.rectangle((0, 0.5 * WIDTH, 0.5 * HEIGHT), "y", (LENGTH, HEIGHT), paint)
    return Scene(s.shapes, s.names, (ROOM,))


def wall_trajectory(frames: int) -> Float64:
    """Return [frames, 4, 4] camera-to-world poses: it sways along the wall, turning a little.

    A step is at most 4 cm and 1 degree with 60 frames, and never long the same.
    """
    return np.stack([_pose(2.0 * np.pi * k / max(1, frames - 1)) for k in range(frames)])


def _pose(a: float) -> Float64:
    yaw, pitch, roll = np.radians([4.0 * np.sin(a + 0.4), 3.0 * np.sin(2.0 * a), 4.0 * np.sin(a)])
    T_wc = np.eye(4)
    T_wc[:3, :3] = looking(0.5 * np.pi + yaw, pitch, roll)
    T_wc[:3, 3] = (
        0.3 * np.sin(a),
        0.5 * WIDTH - _DISTANCE + 0.05 * np.sin(2.0 * a),
        0.5 * HEIGHT + 0.1 * np.sin(2.0 * a),
    )
    return T_wc
