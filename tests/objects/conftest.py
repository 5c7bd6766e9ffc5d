# SPDX-License-Identifier: Apache-2.0
"""Shared fixture: a wall with a square on it, seen from several places."""

from collections.abc import Callable

import numpy as np
import pytest

from ggwarp.geometry.camera import Camera
from ggwarp.objects.masks.mask_view import PosedDepth

View = tuple[PosedDepth, np.ndarray]


@pytest.fixture
def wall_from() -> Callable[..., View]:
    """Return a function of x, z that says where the pixels of a wall are, and which show a square on it.

    The wall is at z = 2 m, the camera at (x, 0, 2 - z), and the square goes from -0.3 to 0.3 m.
    """
    camera = Camera(60, 40, 50.0, 50.0, 29.5, 19.5)

    def look(x: float, z: float = 2.0) -> View:
        T_wc = np.eye(4)
        T_wc[:3, 3] = x, 0.0, 2.0 - z
        view = PosedDepth(np.full((40, 60), z, np.float32), T_wc, camera)
        points = view.points(np.ones((40, 60), bool), 60 * 40).reshape(40, 60, 3)
        return view, (np.abs(points[..., :2]) < 0.3).all(axis=2)

    return look
