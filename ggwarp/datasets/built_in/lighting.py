# SPDX-License-Identifier: Apache-2.0
"""The light of the built-in scenes: each room's lamps and windows, baked on a grid of its own."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ggwarp.datasets.built_in.scene import RoomLight, Scene, device_arrays, primitive_rows
from ggwarp.kernels.scene import raycast, shading

_LIGHTS = 3
"""Lamps and windows of a room, at most: what a cell of the grid has place for."""


@lru_cache(maxsize=8)
def baked_lights(scene: Scene, device: str) -> tuple[wp.array, tuple[Any, ...]]:
    """Bake the light of every room, with all that stands in it.

    Returns:
        [rooms] shading.Light on ``device``, and its rooms one by one, who own their grids' memory.
    """
    rows, balls = primitive_rows(scene.shapes)
    lights = []
    for room in scene.rooms:
        light = _room_light(room, device)
        # What blocks light lies in the room, or in its walls.
        gap = np.maximum(np.maximum(room.low - balls[:, :3], balls[:, :3] - room.high), 0.0)
        near = np.linalg.norm(gap, axis=1) <= balls[:, 3]
        raycast.bake_light(*device_arrays(rows[near], balls[near], device=device), light, device=device)
        lights.append(light)
    return wp.array(lights, dtype=shading.Light, device=device), tuple(lights)


def _room_light(room: RoomLight, device: str) -> Any:
    """Return the room's light, its grid still empty."""
    lamps = np.zeros((4, _LIGHTS, 3))
    for k, lamp in enumerate(room.lamps):
        lamps[:, k] = lamp.centre, lamp.half_u, lamp.half_v, (lamp.power, 0.0, 0.0)
    light = shading.Light()
    light.low, light.high = wp.vec3(*room.low), wp.vec3(*room.high)
    light.centre, light.half_u, light.half_v = (wp.mat33(*rows.ravel().tolist()) for rows in lamps[:3])
    light.power = wp.vec3(*lamps[3, :, 0].tolist())
    light.ambient, light.cell = room.ambient, room.cell
    light.origin = wp.vec3(*(np.asarray(room.low) + 0.5 * room.cell).tolist())
    size = np.ceil((np.asarray(room.high) - room.low) / room.cell - 1e-9).astype(int)
    light.grid = wp.zeros(tuple(size.tolist()), dtype=wp.vec4, device=device)
    return light
