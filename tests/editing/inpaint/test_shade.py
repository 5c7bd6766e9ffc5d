# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.editing.inpaint.image_inpainting import relighting
from ggwarp.editing.inpaint.shade import NOTICED, Occluder


def _ball(radius: float, height: float) -> np.ndarray:
    """Return points all through a ball over the origin."""
    grid = np.stack(np.meshgrid(*[np.linspace(-radius, radius, 41)] * 3), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= radius] + (0.0, 0.0, height)


@pytest.mark.parametrize(("radius", "height"), [(0.3, 0.5), (0.2, 1.0), (0.4, 0.45)])
def test_a_ball_blocks_its_form_factor(radius, height):
    """Of a ball straight over a plane that is (radius / height)^2, and cos times that beside it."""
    occluder = Occluder.of(_ball(radius, height))
    beside = 0.7
    shares = occluder.blocked(np.array([[0.0, 0.0, 0.0], [beside, 0.0, 0.0]]), np.eye(3))
    away = np.hypot(height, beside)
    expected = [(radius / height) ** 2, height / away * (radius / away) ** 2]
    # Voxels are a little larger than what they hold, and the rays are few.
    np.testing.assert_allclose(shares, expected, atol=0.07)


def test_nothing_is_blocked_from_behind_or_far_off():
    occluder = Occluder.of(_ball(0.3, 0.5))
    points = np.array([[0.0, 0.0, 2.0], [40.0, 0.0, 0.0]])
    np.testing.assert_array_equal(occluder.blocked(points, np.eye(3)), 0.0)
    turned = np.diag([1.0, -1.0, -1.0])  # a surface that faces down, over the ball
    assert occluder.blocked(points[:1], turned)[0] > 0.005
    assert Occluder.of(np.zeros((1, 3))).blocked(points, np.eye(3)).shape == (2,)


def _shaded_floor() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a striped floor, the same with a soft shade in its middle, and the light that is blocked."""
    v, u = np.mgrid[:80, :100]
    blocked = (0.6 * np.exp(-((u - 50.0) ** 2 + (v - 40.0) ** 2) / 200.0)).astype(np.float32)
    floor = (150.0 + 25.0 * (u // 3 % 2) - 0.05 * v)[..., None] * (1.0, 0.8, 0.6)
    return floor, floor * (1.0 - blocked[..., None]), blocked


def test_shade_goes_and_the_pattern_stays():
    floor, seen, blocked = _shaded_floor()
    rgb, known = np.rint(seen).astype(np.uint8), np.ones(blocked.shape, bool)
    gain = relighting(rgb, known, blocked)
    there = blocked > 0.05
    before, after = (np.abs(x / floor - 1.0)[there].mean() for x in (rgb, rgb * gain[..., None]))
    # The shade that is not noticed is left, and the floor's own slope over the middle.
    assert before > 0.2 and after < 1.5 * NOTICED
    np.testing.assert_array_equal(gain[~there], 1.0)


def test_shade_of_something_else_stays():
    """No brighter than by the light that was blocked; darkness that the object does not explain is kept."""
    floor, _, blocked = _shaded_floor()
    rgb = np.rint(floor * np.where(blocked > 0.05, 0.3, 1.0)[..., None]).astype(np.uint8)
    gain = relighting(rgb, np.ones(blocked.shape, bool), blocked)
    assert (gain <= 1.0 / (1.0 - blocked) + 1e-5).all()
    np.testing.assert_array_equal(relighting(rgb, np.ones(blocked.shape, bool), 0.0 * blocked), 1.0)


def test_what_is_brighter_there_or_not_known_is_left():
    floor, _, blocked = _shaded_floor()
    brighter = np.rint(np.where(blocked[..., None] > 0.05, 1.3 * floor, floor).clip(0, 255)).astype(np.uint8)
    known = np.ones(blocked.shape, bool)
    known[30:50, 45:55] = False
    gain = relighting(brighter, known, blocked)
    np.testing.assert_array_equal(gain[~known], 1.0)
    assert gain[blocked > 0.3].mean() < 1.02
    np.testing.assert_array_equal(relighting(brighter, ~known & False, blocked), 1.0)
    np.testing.assert_array_equal(relighting(brighter, known, np.ones_like(blocked)), 1.0)
