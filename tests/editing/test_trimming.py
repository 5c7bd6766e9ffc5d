# SPDX-License-Identifier: Apache-2.0
"""A board whose last Gaussian runs on behind a screen."""

import numpy as np
import pytest

from ggwarp.editing.edits import extract
from ggwarp.editing.map_view import MapView
from ggwarp.editing.trimming import trimmed
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import SH_C0, Gaussians, join

CAMERA = Camera(96, 64, 100.0, 100.0, 47.5, 31.5)
BOARD, SCREEN, TAIL = 2.5, 2.0, 0.2
POSES = np.stack([np.eye(4)] * 3)
POSES[:, 0, 3] = [-0.3, 0.0, 0.3]
PLACE = np.array([0.05, 0.0, BOARD])


def _flat(points: np.ndarray, grey: float, object_id: int, spread: tuple[float, float]) -> Gaussians:
    n = len(points)
    return Gaussians(
        points.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.tile(np.log(np.float32([*spread, 0.004])), (n, 1)),
        np.full(n, 4.0, np.float32),
        np.full((n, 3), (grey - 0.5) / SH_C0, np.float32),
        np.full(n, object_id, np.int32),
    )


def _sheet(left: float, right: float, z: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(left, right, 0.04), np.arange(-0.3, 0.3, 0.04))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)


def _right_end(gaussians: Gaussians) -> float:
    """Return where the tail ends, two standard deviations from its centre, metres."""
    return float(gaussians.means[0, 0] + 2.0 * np.exp(gaussians.log_scales[0, 0]))


@pytest.fixture(scope="module")
def whole() -> Gaussians:
    """The tail's Gaussian comes first, then the board's others, then the screen's."""
    small = (0.03, 0.03)
    return join(
        _flat(PLACE[None], 0.9, 5, (TAIL, 0.03)),
        _flat(_sheet(-0.4, 0.05, BOARD), 0.9, 5, small),
        _flat(_sheet(0.2, 0.9, SCREEN), 0.2, 6, small),
    )


def _beyond(gaussians: Gaussians) -> float:
    """Return how opaque the tail is behind the screen, as seen from the middle."""
    return float(MapView(gaussians, CAMERA).render(POSES[1]).opacity[30:34, 62:68].mean())


def test_what_no_view_shows_is_cut_off(whole, device):
    board = whole.object_ids == 5
    view = MapView(whole, CAMERA, device=device)
    cut = trimmed(view, board, POSES)
    plain = extract(whole, board)
    assert len(cut) == len(plain)
    # From the left the screen begins to hide what is at the board's distance at about 0.3 m.
    assert 0.15 < _right_end(cut) < 0.32 < _right_end(plain)
    assert _beyond(plain) > 0.05
    assert _beyond(cut) < 0.3 * _beyond(plain)


def test_all_else_stays_as_it_is(whole):
    board = whole.object_ids == 5
    cut, plain = trimmed(MapView(whole, CAMERA), board, POSES), extract(whole, board)
    inner = plain.means[:, 0] < -0.05
    inner &= (np.abs(plain.means[:, 1]) < 0.2) & (plain.means[:, 0] > -0.35)
    inner[0] = False
    assert inner.sum() > 30
    np.testing.assert_array_equal(cut.log_scales[inner], plain.log_scales[inner])
    np.testing.assert_array_equal(cut.means[inner], plain.means[inner])
    for name, array in plain.arrays().items():
        if name not in ("means", "log_scales"):
            np.testing.assert_array_equal(getattr(cut, name), array)


def test_what_is_seen_stays_longer(whole):
    """Without the screen more of the tail is seen: it is the object's, as far as half a pixel is."""
    alone = extract(whole, whole.object_ids == 5)
    free = trimmed(MapView(alone, CAMERA), np.ones(len(alone), bool), POSES)
    hidden = trimmed(MapView(whole, CAMERA), whole.object_ids == 5, POSES)
    assert _right_end(hidden) + 0.04 < _right_end(free) <= _right_end(alone)


def test_what_no_view_shows_at_all_stays(whole):
    board = whole.object_ids == 5
    away = np.eye(4)[None].repeat(2, axis=0)
    away[:, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    cut = trimmed(MapView(whole, CAMERA), board, away)
    np.testing.assert_array_equal(cut.means, extract(whole, board).means)
    assert len(trimmed(MapView(whole, CAMERA), whole.object_ids == 7, POSES)) == 0
