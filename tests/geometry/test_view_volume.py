# SPDX-License-Identifier: Apache-2.0
"""What may be in view, against pixels."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.view_volume import ViewVolume, median_reading, reach_of, same_reach

CAMERA = Camera(64, 48, 60.0, 55.0, 28.0, 25.0)


@given(seed=st.integers(0, 2**32 - 1))
def test_no_ball_is_left_out_of_which_the_picture_shows_a_point(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_wc = se3.se3_exp(rng.normal(size=6))
    centres, radii = rng.uniform(-4.0, 4.0, (200, 3)), rng.uniform(0.01, 0.8, 200)
    depth = rng.uniform(0.5, 3.0, (48, 64)).astype(np.float32)
    offsets = rng.normal(size=(50, 3))
    offsets *= rng.uniform(0.0, 1.0, (50, 1)) / np.linalg.norm(offsets, axis=1, keepdims=True)
    points = centres[:, None] + radii[:, None, None] * offsets
    local = se3.transform_points(se3.inverse(T_wc), points.reshape(-1, 3)).reshape(points.shape)
    rows, columns, inside = CAMERA.pixels_of(local)
    shown = (inside & (local[..., 2] <= depth[rows, columns])).any(axis=1)

    touches = ViewVolume(CAMERA).touches(se3.inverse(T_wc), reach_of(depth), centres, radii)

    assert (touches | ~shown).all()


def test_what_is_beside_behind_or_beyond_is_not_in_view() -> None:
    centres = np.array([[0.0, 0, 2], [0, 0, -2], [0, 0, 6], [4, 0, 2], [-4, 0, 2], [0, 4, 2], [0, -4, 2]])
    volume = ViewVolume(CAMERA)
    poses = np.stack([np.eye(4), se3.se3_exp([0.0, 0, 0, 0, np.pi, 0])])

    seen = volume.touches(poses, np.stack([same_reach(5.0)] * 2), centres, np.full(7, 0.5))

    assert seen[0].tolist() == [True] + 6 * [False]
    assert seen[1].tolist() == [False, True] + 5 * [False]
    assert not volume.touches(np.eye(4), same_reach(5.0), np.zeros((0, 3)), np.zeros(0)).any()


def test_what_a_wall_hides_is_not_in_view() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 4.0
    depth[0, 0] = np.nan
    centres = np.array([[-0.8, 0.0, 3.0], [0.8, 0.0, 3.0], [-0.8, 0.0, 2.2], [0.0, 0.0, 3.0]])
    seen = ViewVolume(CAMERA).touches(np.eye(4), reach_of(depth), centres, np.full(4, 0.3))
    assert seen.tolist() == [False, True, True, True]
    few = reach_of(depth[:3, :5])
    assert few.shape == (6, 8) and few.max() == 2.0


def test_readings_of_nothing_have_no_say_in_their_median(rng: np.random.Generator) -> None:
    depth = rng.uniform(0.5, 4.0, (9, 11)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.4] = 0.0
    readings = np.sort(depth[depth > 0.0])
    assert median_reading(depth) == readings[len(readings) // 2]
    assert median_reading(np.float32([[0.0, 2.0]])) == 2.0
    assert median_reading(np.zeros((3, 4), np.float32)) == 0.0
