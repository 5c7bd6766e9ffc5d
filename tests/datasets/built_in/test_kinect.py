# SPDX-License-Identifier: Apache-2.0
"""A Kinect's depth noise: what was published holds of what it does."""

import numpy as np
import pytest

from ggwarp.datasets.built_in.kinect import (
    BIAS,
    DISPARITY_CONSTANT,
    DISPARITY_STEP,
    KINECT_CAMERA,
    RANGE,
    axial_sigma,
    disparity_offset,
    kinect_depth,
)

SMALL = KINECT_CAMERA.scaled(0.5)
SHAPE = (SMALL.height, SMALL.width)


def _plane(z: float) -> np.ndarray:
    return np.full(SHAPE, z, np.float32)


def _measured(z: float, frames: int = 40) -> np.ndarray:
    return np.stack([kinect_depth(_plane(z), SMALL, index, 3) for index in range(frames)])


@pytest.mark.parametrize("z", [0.8, 1.5, 2.5, 3.5])
def test_a_pixel_scatters_as_nguyen_measured(z):
    """Each pixel over time: its lasting offset aside, what is published for a plane seen head-on."""
    seen = _measured(z)
    assert np.all(seen > 0)
    scatter = np.sqrt(np.mean(np.var(seen, axis=0, ddof=1)))
    assert scatter == pytest.approx(float(axial_sigma(np.float32(z))), rel=0.06)


def test_it_comes_in_steps_of_disparity():
    for z in (1.0, 3.0):
        steps = DISPARITY_CONSTANT / _measured(z, 2) / DISPARITY_STEP
        assert np.allclose(steps, np.round(steps), atol=2e-3)
    # Khoshelham and Elberink: neighbouring readings at 5 m are 7 cm apart.
    levels = np.unique(np.round(_measured(4.9, 4), 4))
    levels = levels[levels > 4.6]
    assert np.median(np.diff(levels)) == pytest.approx(0.0285 * 0.1 * 4.8**2, rel=0.1)


def test_a_lasting_error_grows_with_the_square_of_depth():
    """The mean over many frames is off, alike in a neighbourhood, and by z^2 times the same field."""
    fields = []
    for z in (1.5, 3.0):
        off = (_measured(z, 60).mean(axis=0) - z) / z**2 * DISPARITY_CONSTANT
        assert np.std(off) == pytest.approx(BIAS, rel=0.25)
        fields.append(off)
    expected = -disparity_offset(SHAPE, 3)
    for off in fields:
        assert np.corrcoef(off.ravel(), expected.ravel())[0, 1] > 0.9
    far = np.corrcoef(expected[:, :-20].ravel(), expected[:, 20:].ravel())[0, 1]
    assert far > 0.8, "smooth: twenty pixels on it is much the same"
    assert not np.array_equal(disparity_offset(SHAPE, 3), disparity_offset(SHAPE, 4))


def test_neighbours_err_alike():
    noise = _measured(3.0, 60) - _measured(3.0, 60).mean(axis=0)

    def alike(step: int) -> float:
        return float(np.corrcoef(noise[:, :, :-step].ravel(), noise[:, :, step:].ravel())[0, 1])

    # Rounding has its own share of the noise, and is nobody's neighbour.
    rounding = DISPARITY_STEP / DISPARITY_CONSTANT * 3.0**2 / np.sqrt(12.0)
    share = 1.0 - (rounding / float(axial_sigma(np.float32(3.0)))) ** 2
    window = 0.5 * 9.0 / np.sqrt(12.0)
    for step in (1, 2, 3):
        assert alike(step) == pytest.approx(share * np.exp(-((0.5 * step / window) ** 2)), abs=0.08)
    assert abs(alike(12)) < 0.02


def test_edges_are_ragged_and_cast_a_shadow():
    """A board before a wall: its rims stray by a pixel, and one side of it the projector does not see."""
    depth = _plane(3.0)
    depth[:, 120:200] = 1.5
    seen = np.stack([kinect_depth(depth, SMALL, index, 0) for index in range(20)])
    board = (seen > 0) & (seen < 2.2)
    rim = [np.argmax(board[:, :, ::-1], axis=2), np.argmax(board, axis=2)]
    widths = [np.std(r) for r in rim]
    assert 0.2 < widths[0] < 1.2, "0.8 pixels at 640, half as many here"
    shadow = 0.075 * SMALL.fx * (1 / 1.5 - 1 / 3.0)
    assert np.mean(np.sum(seen[:, :, 95:130] == 0, axis=2)) == pytest.approx(shadow, abs=1.5)
    assert np.mean(seen[:, :, 200:230] == 0) < 0.1, "on the other side there is none"
    flat = seen[:, :, 140:180]
    assert np.all((flat > 1.4) & (flat < 1.6)), "within a surface nothing strays"


def test_no_depth_near_far_or_edge_on():
    near, far = kinect_depth(_plane(0.4), SMALL, 0, 0), kinect_depth(_plane(5.6), SMALL, 0, 0)
    assert not near.any() and not far.any() and RANGE == (0.5, 5.0)
    u = np.arange(SMALL.width) - SMALL.cx
    for angle, there in ((5.0, False), (30.0, True)):
        # A wall that runs away from the camera at ``angle`` to the line of sight in the middle.
        slope = 1.0 / np.tan(np.radians(angle))
        z = 2.0 / (1.0 - slope * u / SMALL.fx)
        row = np.where((z > 0) & (z < 20), z, 0).astype(np.float32)
        seen = kinect_depth(np.tile(row, (SHAPE[0], 1)), SMALL, 0, 0)
        assert np.mean(seen[:, 158:162] > 0) == float(there)
    assert not kinect_depth(_plane(0.0), SMALL, 0, 0).any()


def test_the_same_frame_is_the_same_and_another_is_not():
    a, b, c = (kinect_depth(_plane(2.0), SMALL, index, seed) for index, seed in ((5, 1), (5, 1), (6, 1)))
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    assert not np.array_equal(a, kinect_depth(_plane(2.0), SMALL, 5, 2))
