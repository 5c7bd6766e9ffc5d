# SPDX-License-Identifier: Apache-2.0
"""A board before a shaded wall: what is behind it, and what is put there."""

import numpy as np
import pytest

from ggwarp.editing.edits import extract, remove
from ggwarp.editing.inpaint.filling import fill_removed
from ggwarp.editing.inpaint.holes import FREE, SEEN, UNSEEN, find_holes
from ggwarp.editing.inpaint.image_inpainting import inpaint_shade
from ggwarp.editing.inpaint.object_views import ObjectView, share_in_the_clear, view_object
from ggwarp.editing.inpaint.plane_texture import paint, sampled
from ggwarp.editing.map_view import MapView
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import SH_C0, Gaussians, join

CAMERA = Camera(120, 80, 140.0, 140.0, 59.5, 39.5)
SIDE, FRONT, WALL = 0.2, 2.5, 3.0
POSES = np.stack([np.eye(4)] * 5)
POSES[:, 0, 3] = [-0.4, -0.2, 0.0, 0.2, 0.4]


def _flat(points: np.ndarray, normal_axis: int, colours: np.ndarray, object_id: int) -> Gaussians:
    n = len(points)
    scales = np.full((n, 3), np.log(0.024), np.float32)
    scales[:, normal_axis] = np.log(0.004)
    return Gaussians(
        points.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        scales,
        np.full(n, 3.0, np.float32),
        ((colours - 0.5) / SH_C0).astype(np.float32),
        np.full(n, object_id, np.int32),
        np.full((n, 16), object_id, np.float32),
    )


def _grid(low: float, high: float, step: float = 0.03) -> np.ndarray:
    at = np.arange(low, high + 1e-9, step)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def _wall_colours(points: np.ndarray) -> np.ndarray:
    return np.stack([0.5 + 0.2 * points[:, 0], 0.5 + 0.2 * points[:, 1], np.full(len(points), 0.4)], axis=1)


def _hidden(points: np.ndarray) -> np.ndarray:
    """Return which points of the wall the board hides from every pose."""
    hidden = np.ones(len(points), bool)
    for T_wc in POSES:
        at = T_wc[:2, 3] + (points[:, :2] - T_wc[:2, 3]) * FRONT / WALL
        hidden &= np.abs(at).max(axis=1) < SIDE
    return hidden


def _object_views(whole: MapView, kept: MapView, board: np.ndarray) -> list[ObjectView]:
    return [view_object(whole, kept, T_wc, whole.coverage(T_wc, board)[0]) for T_wc in POSES]


@pytest.fixture(scope="module")
def wall() -> Gaussians:
    points = np.insert(_grid(-2.0, 2.0, 0.04), 2, WALL, axis=1)
    return _flat(points, 2, _wall_colours(points), 1)


@pytest.fixture(scope="module")
def whole(wall: Gaussians) -> Gaussians:
    """The wall as far as it was ever seen, and the board."""
    face = np.insert(_grid(-SIDE, SIDE), 2, FRONT, axis=1)
    board = _flat(face, 2, np.tile([0.9, 0.1, 0.1], (len(face), 1)), 5)
    return join(remove(wall, _hidden(wall.means)), board)


def test_the_hole_is_what_nobody_saw(whole, wall, device):
    board = whole.object_ids == 5
    kept = remove(whole, board)
    views = MapView(whole, CAMERA, device=device), MapView(kept, CAMERA, device=device)
    holes = find_holes(kept, _object_views(*views, board), CAMERA)
    assert len(holes) == 1
    hole = holes[0]
    assert abs(hole.plane.normal[2]) > 0.999 and abs(hole.plane.origin[2] - WALL) < 0.01
    found = hole.centres(hole.needed)
    hidden = wall.means[_hidden(wall.means)]
    assert 0.5 < hole.needed.sum() * hole.cell**2 / (len(hidden) * 0.04**2) < 1.6
    np.testing.assert_allclose(found.mean(0), hidden.mean(0), atol=0.03)
    everywhere = hole.centres(np.ones_like(hole.needed))
    states = hole.states.ravel()
    inner = (np.abs(everywhere[:, :2]) < 0.1).all(axis=1)
    outer = (np.abs(everywhere[:, :2]) > 0.45).any(axis=1)
    assert (states[inner] == UNSEEN).all() and (states[outer] == SEEN).mean() > 0.95
    assert not (states == FREE).any()


def test_the_wall_goes_on_behind(whole, wall, device):
    board = whole.object_ids == 5
    filled, added = fill_removed(whole, board, CAMERA, POSES, device=device)
    assert added == (filled.object_ids == 1).sum() - (len(filled) - added) and 30 < added < 1000
    assert not (filled.object_ids == 5).any() and len(filled.identities) == len(filled)
    np.testing.assert_allclose(filled.means[-added:, 2], WALL, atol=0.02)
    empty = MapView(remove(whole, board), CAMERA, device=device)
    truth, seen = MapView(wall, CAMERA, device=device), MapView(filled, CAMERA, device=device)
    for T_wc in POSES[1:4]:
        bare, true, now = (v.render(T_wc) for v in (empty, truth, seen))
        hole = bare.opacity < 0.5
        assert hole.sum() > 20 and now.opacity[hole].min() > 0.8
        # The wall's shade goes on in the hole, and the rest of the picture stays.
        assert np.abs(now.rgb - true.rgb)[hole].mean() < 0.04
        away = bare.opacity > 0.95
        assert np.abs(now.rgb - bare.rgb)[away].mean() < 0.004


def test_what_stands_out_from_the_wall_ends_where_the_wall_is_seen_beside_it(whole, device):
    """Two posts before the wall, left and right of the board: nothing is between them but the wall."""
    feet = [np.array([x, y]) for x in (-0.44, 0.44) for y in np.arange(-0.7, 0.7, 0.08)]
    at = np.concatenate([_grid(-0.03, 0.03, 0.02) + foot for foot in feet])
    posts = _flat(np.insert(at, 2, WALL - 0.08, axis=1), 2, np.tile([0.1, 0.1, 0.9], (len(at), 1)), 3)
    scene = join(whole, posts)
    filled, added = fill_removed(scene, scene.object_ids == 5, CAMERA, POSES, device=device)
    new = filled.means[-added:]
    behind = new[(np.abs(new[:, :2]) < 0.15).all(axis=1)]
    assert len(behind) > 20 and (np.abs(behind[:, 2] - WALL) < 0.02).mean() > 0.95


def test_what_was_never_seen_apart_from_the_board_goes_with_it(whole, device):
    """Streaks behind the board, which no picture ever contradicted."""
    at = np.insert(_grid(-0.1, 0.1), 2, WALL - 0.1, axis=1)
    scene = join(whole, _flat(at, 2, np.tile([0.9, 0.9, 0.1], (len(at), 1)), 7))
    board = scene.object_ids == 5
    views = MapView(scene, CAMERA, device=device), MapView(remove(scene, board), CAMERA, device=device)
    covers = [views[0].coverage(T_wc, board)[0] for T_wc in POSES]
    share, behind = share_in_the_clear(*views, list(POSES), covers, board)
    ids = scene.object_ids[~board]
    assert share[ids == 7].max() < 0.1 and behind[ids == 7].all()
    far = (np.abs(scene.means[~board][:, :2]) > 0.5).any(axis=1) & (np.abs(scene.means[~board][:, 0]) < 0.9)
    far &= np.abs(scene.means[~board][:, 1]) < 0.7
    assert not behind[far].any()
    beside = (scene.object_ids[~board] == 1) & behind & (share > 0.9)
    assert beside.sum() > 20  # wall that one view hides and another shows
    filled, added = fill_removed(scene, board, CAMERA, POSES, device=device)
    assert not (filled.object_ids[:-added] == 7).any()
    old = whole.object_ids == 1
    assert (filled.object_ids[:-added] == 1).sum() > 0.97 * old.sum()


def test_a_plane_is_painted_as_it_was_seen(whole, device):
    board = whole.object_ids == 5
    kept = remove(whole, board)
    views = MapView(whole, CAMERA, device=device), MapView(kept, CAMERA, device=device)
    views = _object_views(*views, board)
    hole = find_holes(kept, views, CAMERA)[0]
    surface = paint(hole, views, CAMERA, inpaint_shade, margin=8, tolerance=0.01)
    at = hole.plane.points(hole.plane.coordinates(hole.centres(hole.states == SEEN))[:, :2])
    away = (np.abs(at[:, :2]) > 0.33).any(axis=1) & (np.abs(at[:, 0]) < 0.8) & (np.abs(at[:, 1]) < 0.6)
    assert away.sum() > 50
    error = np.abs(surface.colours(at) / 255.0 - _wall_colours(at))[away]
    assert error.mean() < 0.02  # no red of the board's outline
    picture = np.arange(24, dtype=float).reshape(2, 4, 3)
    between = sampled(picture, np.array([0.5, 3.0, 9.0]), np.array([0.5, 1.0, -4.0]))
    np.testing.assert_allclose(between[:, 0], [7.5, 21.0, 9.0])


def test_any_inpainter_can_be_given(whole):
    def green(rgb, mask, wanted):
        assert rgb.dtype == np.uint8 and mask.dtype == bool and mask.any() and not mask.all()
        assert wanted.any() and not (wanted & ~mask).any()
        return np.where(mask[..., None], np.array([0, 255, 0], np.uint8), rgb)

    filled, added = fill_removed(whole, whole.object_ids == 5, CAMERA, POSES, inpaint=green)
    shown = 0.5 + SH_C0 * filled.colours[-added:]
    assert np.median(shown[:, 1]) > 0.9 and np.median(shown[:, 0]) < 0.1


def test_without_a_plane_the_views_are_inpainted(whole, wall, rng):
    """Round Gaussians scattered in depth: no plane fits, and the hole is filled all the same."""
    kept = remove(wall, np.abs(wall.means[:, :2]).max(axis=1) < 0.3)
    rough = kept.means.copy()
    rough[:, 2] += rng.uniform(-0.15, 0.15, len(rough))
    quats = rng.normal(size=(len(rough), 4)).astype(np.float32)
    scattered = Gaussians(
        rough,
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        kept.log_scales,
        *list(vars(kept).values())[3:],
    )
    board = extract(whole, whole.object_ids == 5)
    both = join(scattered, board)
    filled, added = fill_removed(both, both.object_ids == 5, CAMERA, POSES)
    assert added > 50
    view = MapView(filled, CAMERA).render(POSES[2])
    hole = MapView(scattered, CAMERA).render(POSES[2]).opacity < 0.5
    hole[:15] = hole[-15:] = False
    hole[:, :20] = hole[:, -20:] = False
    assert hole.sum() > 50 and np.mean(view.opacity[hole] > 0.5) > 0.95
    assert np.abs(filled.means[-added:, 2] - WALL).max() < 0.5


def test_nothing_to_fill(whole, wall):
    board = whole.object_ids == 5
    away = POSES.copy()
    away[:, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    same, added = fill_removed(whole, board, CAMERA, away)
    assert added == 0 and len(same) == (~board).sum()
    alone, added = fill_removed(extract(whole, board), np.ones(board.sum(), bool), CAMERA, POSES)
    assert added == 0 and len(alone) == 0


def test_twice_gives_the_same_bits(whole):
    board = whole.object_ids == 5
    one, two = (fill_removed(whole, board, CAMERA, POSES)[0] for _ in range(2))
    for name, values in one.arrays().items():
        np.testing.assert_array_equal(values, getattr(two, name))
