# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.editing.windows import footprints, touching, window_of, window_round
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.map.renderer import Renderer

# The principal point is well away from the middle.
CAMERA = Camera(100, 70, 60.0, 55.0, 71.3, 22.2)


def _scattered(rng: np.random.Generator, n: int) -> Gaussians:
    """Gaussians of all sizes in front of, beside and behind a camera."""
    return Gaussians(
        rng.uniform([-3.0, -3.0, -0.5], [3.0, 3.0, 3.0], (n, 3)).astype(np.float32),
        rng.normal(size=(n, 4)).astype(np.float32),
        np.log(rng.uniform(0.001, 0.3, (n, 3))).astype(np.float32),
        rng.uniform(-3.0, 6.0, n).astype(np.float32),
        np.zeros((n, 3), np.float32),
    )


@given(seed=st.integers(0, 10_000), x=st.floats(-0.5, 0.5), yaw=st.floats(-0.6, 0.6))
@settings(max_examples=25)
def test_a_footprint_holds_the_tiles_that_projection_finds(seed: int, x: float, yaw: float) -> None:
    rows = _scattered(np.random.default_rng(seed), 200)
    T_wc = se3.se3_exp([x, 0.0, 0.0, 0.0, yaw, 0.0])
    model = GaussianMap(device="cpu", has_identity=False, capacity=200)
    model.append(rows)
    renderer = Renderer(model, CAMERA)
    renderer.render(T_wc)
    rects = renderer.splats.tile_rects.numpy()
    held = footprints(rows, CAMERA, T_wc)
    for k in np.nonzero(rects[:, 2] > rects[:, 0])[0]:
        x0, y0, x1, y1 = window_round(held[k : k + 1], CAMERA) or (0, 0, 0, 0)
        assert x0 <= 16 * rects[k, 0] and y0 <= 16 * rects[k, 1]
        assert min(16 * rects[k, 2], CAMERA.width) <= x1 and min(16 * rects[k, 3], CAMERA.height) <= y1
        assert touching(held[k : k + 1], (x0, y0, x1, y1)).all()


def test_a_footprint_is_no_larger_than_its_ball() -> None:
    ball = Gaussians(
        np.float32([[0.0, 0.0, 2.0]]),
        np.float32([[1, 0, 0, 0]]),
        np.log(np.float32([[0.02, 0.02, 0.02]])),
        np.float32([5.0]),
        np.zeros((1, 3), np.float32),
    )
    x0, y0, x1, y1 = footprints(ball, CAMERA, np.eye(4))[0]
    assert x0 < CAMERA.cx < x1 and y0 < CAMERA.cy < y1
    # Three and a third standard deviations of 0.6 pixels, wider by the low-pass, to either side.
    assert x1 - x0 < 12.0


def test_what_is_behind_the_camera_has_no_window() -> None:
    rows = _scattered(np.random.default_rng(0), 20)
    rows.means[:, 2] = -1.0
    held = footprints(rows, CAMERA, np.eye(4))
    assert window_round(held, CAMERA) is None and not touching(held, (0, 0, 100, 70)).any()
    assert window_round(held[:0], CAMERA) is None


@pytest.mark.parametrize(
    ("place", "window"),
    [
        ((20, 40), (32, 16, 48, 32)),
        ((0, 0), (0, 0, 16, 16)),
        ((69, 99), (96, 64, 100, 70)),
    ],
)
def test_pixels_have_whole_tiles(place: tuple[int, int], window: tuple[int, int, int, int]) -> None:
    pixels = np.zeros((CAMERA.height, CAMERA.width), bool)
    assert window_of(pixels, CAMERA) is None
    pixels[place] = True
    assert window_of(pixels, CAMERA) == window


def test_a_margin_is_kept_within_the_image() -> None:
    held = np.array([[30.0, 20.0, 34.0, 21.0]])
    assert window_round(held, CAMERA) == (16, 16, 48, 32)
    assert window_round(held, CAMERA, margin=5) == (16, 0, 48, 32)
    assert window_round(held, CAMERA, margin=900) == (0, 0, 100, 70)
