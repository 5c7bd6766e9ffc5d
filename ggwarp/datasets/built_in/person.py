# SPDX-License-Identifier: Apache-2.0
"""A person who walks through a built-in scene: an object that stands elsewhere in every frame."""

from __future__ import annotations

import numpy as np

from ggwarp.datasets.built_in.furniture import DARK, cloth
from ggwarp.datasets.built_in.scene import Material, SceneBuilder, Shape
from ggwarp.kernels.scene import procedural as patterns
from ggwarp.types import Float64

_STRIDE = 0.70
"""Length of a step, metres."""
_SWING = np.radians(24.0)
"""Of a leg, either way."""

_SKIN = cloth((0.72, 0.52, 0.42), (0.84, 0.64, 0.52), 0.08)
_JEANS = cloth((0.16, 0.22, 0.38), (0.28, 0.36, 0.54), 0.10)
_SHIRT = Material((0.74, 0.22, 0.20), (0.90, 0.86, 0.80), patterns.STRIPES, 0.09)
_HAIR = cloth((0.16, 0.10, 0.07), (0.30, 0.20, 0.14), 0.05)


def person_shapes(names: dict[int, str], at: Float64, heading: float, walked: float) -> list[Shape]:
    """Return a person of 1.75 m in mid-walk.

    Args:
        names: of the scene's objects; the person is the next one.
        at: [2] metres, between the feet.
        heading: where to, radians from east over north.
        walked: metres since the walk began: tells the step.
    """
    s = SceneBuilder(names=dict(names))
    step = np.pi * walked / _STRIDE
    with s.object("person", (*at, 0.0), np.degrees(heading) + 90.0):
        for side in (-1.0, 1.0):
            swing = side * _SWING * np.sin(step)
            hip = np.array([0.09 * side, 0.0, 0.90])
            knee = hip + 0.43 * np.array([0.0, -np.sin(swing), -np.cos(swing)])
            bent = swing - np.radians(18.0) * max(0.0, side * np.cos(step))
            foot = knee + 0.41 * np.array([0.0, -np.sin(bent), -np.cos(bent)])
            s.rod(knee, hip, 0.060, _JEANS, taper=1.35)
            s.rod(foot, knee, 0.045, _JEANS, taper=1.3)
            s.ball(foot + np.array([0.0, -0.06, -0.02]), (0.048, 0.13, 0.045), DARK)
            shoulder = np.array([0.21 * side, 0.0, 1.42])
            elbow = shoulder + 0.29 * np.array([0.10 * side, np.sin(swing), -np.cos(swing)])
            hand = elbow + 0.26 * np.array([0.0, np.sin(swing) - 0.35, -np.cos(swing)])
            s.rod(elbow, shoulder, 0.045, _SHIRT, taper=1.2)
            s.rod(hand, elbow, 0.032, _SKIN, taper=1.25)
            s.ball(hand, (0.04, 0.045, 0.06), _SKIN)
        s.ball((0, 0, 0.94), (0.17, 0.12, 0.13), _JEANS)
        s.ball((0, 0, 1.20), (0.20, 0.125, 0.30), _SHIRT)
        s.rod((0, 0, 1.44), (0, 0, 1.54), 0.055, _SKIN)
        s.ball((0, -0.01, 1.62), (0.085, 0.105, 0.125), _SKIN)
        s.ball((0, 0.02, 1.655), (0.092, 0.10, 0.105), _HAIR)
    return s.shapes
