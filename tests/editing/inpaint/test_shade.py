# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.editing.inpaint.image_inpainting import relighting
from ggwarp.editing.inpaint.shade import NOTICED, Occluder, Shade, Surroundings, most_gain
from ggwarp.map.gaussians import SH_C0, Gaussians


def _ball(radius: float, height: float) -> np.ndarray:
    """Return points all through a ball over the origin."""
    grid = np.stack(np.meshgrid(*[np.linspace(-radius, radius, 41)] * 3), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= radius] + (0.0, 0.0, height)


def _map(points: np.ndarray, brightness: float | np.ndarray, spread: float = 0.02) -> Gaussians:
    """Return round, opaque Gaussians at ``points``, as bright as that."""
    n = len(points)
    grey = np.broadcast_to(np.asarray(brightness, np.float32), n)
    return Gaussians(
        points.astype(np.float32),
        np.tile(np.float32([1.0, 0.0, 0.0, 0.0]), (n, 1)),
        np.full((n, 3), np.log(spread), np.float32),
        np.full(n, 3.0, np.float32),
        np.repeat(((grey - 0.5) / SH_C0)[:, None], 3, axis=1).astype(np.float32),
    )


def _patch(height: float, half: float) -> np.ndarray:
    """Return points of a level square over the origin."""
    at = np.arange(-half, half + 1e-9, 0.04)
    x, y = np.meshgrid(at, at)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def _shade(ball: np.ndarray, around: Gaussians) -> Shade:
    return Shade(Occluder.of(ball), Surroundings.of(around, ball))


NOTHING = _map(np.zeros((0, 3)), 0.0)


@pytest.mark.parametrize(("radius", "height"), [(0.3, 0.5), (0.2, 1.0), (0.4, 0.45)])
def test_a_ball_keeps_its_form_factor_of_an_even_sky(radius, height):
    """Of a ball straight over a plane that is (radius / height)^2, and cos times that beside it."""
    beside = 0.7
    shade = _shade(_ball(radius, height), NOTHING)
    shares = shade.lost(np.array([[0.0, 0.0, 0.0], [beside, 0.0, 0.0]]), np.eye(3))
    away = np.hypot(height, beside)
    expected = [(radius / height) ** 2, height / away * (radius / away) ** 2]
    # Voxels are a little larger than what they hold, and the rays are few.
    np.testing.assert_allclose(shares, expected, atol=0.07)


def test_nothing_is_lost_from_behind_or_far_off():
    shade = _shade(_ball(0.3, 0.5), NOTHING)
    points = np.array([[0.0, 0.0, 2.0], [40.0, 0.0, 0.0]])
    np.testing.assert_array_equal(shade.lost(points, np.eye(3)), 0.0)
    turned = np.diag([1.0, -1.0, -1.0])  # a surface that faces down, over the ball
    assert shade.lost(points[:1], turned)[0] > 0.005
    assert _shade(np.zeros((1, 3)), NOTHING).lost(points, np.eye(3)).shape == (2,)


def test_a_ray_that_would_not_go_free_is_no_loss():
    """Under a board the ball over it takes no light; below the same board it takes what the board sends."""
    ball, place = _ball(0.3, 0.9), np.zeros((1, 3))
    alone = _shade(ball, NOTHING).lost(place, np.eye(3))[0]
    board = _map(_patch(0.4, 1.0), 0.5)
    assert alone > 0.08
    assert _shade(ball, board).lost(place, np.eye(3))[0] < 0.01


def test_what_is_dark_behind_an_object_is_little_lost():
    ball, place = _ball(0.25, 0.6), np.zeros((1, 3))
    above = _patch(1.2, 2.4)
    near = np.abs(above).max(axis=1, initial=0.0, where=[True, True, False]) < 0.6
    even, dark, lamp = (
        _shade(ball, _map(above, np.where(near, b, 0.5))).lost(place, np.eye(3))[0] for b in (0.5, 0.1, 1.0)
    )
    assert dark < 0.5 * even
    assert lamp > 1.2 * even


def test_surroundings_are_seen_where_they_are():
    around = Surroundings.of(_map(_patch(1.0, 1.0), 0.8), np.zeros((4, 3)))
    rays = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.6, 0.0, 0.8]])
    brightness, distance = around.look(np.array([[0.1, 0.0, 0.0]]), rays, np.full(3, 0.05))
    np.testing.assert_allclose(brightness, 0.8, atol=1e-3)  # what meets nothing brings the mean
    np.testing.assert_allclose(distance[0], [1.0, np.inf, 1.25], atol=2.0 * around.size)


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
    assert (gain <= most_gain(blocked) + 1e-5).all() and gain.max() > 1.3
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
