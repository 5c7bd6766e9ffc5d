# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.evaluation.trajectory import absolute_error, align, relative_error
from ggwarp.geometry import se3


def _poses(rng: np.random.Generator, count: int) -> np.ndarray:
    twists = rng.normal(size=(count, 6))
    return np.stack([se3.se3_exp(t) for t in twists])


def _moved(poses: np.ndarray, T: np.ndarray) -> np.ndarray:
    return T @ poses


def test_a_rigidly_moved_trajectory_has_no_error(rng):
    true = _poses(rng, 20)
    error = absolute_error(_moved(true, se3.se3_exp(rng.normal(size=6))), true)
    assert error.rmse < 1e-12 and error.maximum < 1e-12


def test_scale_is_only_fitted_when_asked(rng):
    true = _poses(rng, 20)
    doubled = true.copy()
    doubled[:, :3, 3] *= 2.0
    assert absolute_error(doubled, true, with_scale=True).rmse < 1e-12
    assert absolute_error(doubled, true).rmse > 0.1


def test_rmse_and_mean_are_what_they_are_called():
    true = np.tile(np.eye(4), (4, 1, 1))
    true[:, :3, 3] = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]
    estimated = true.copy()
    estimated[0, 0, 3], estimated[1, 0, 3] = 1.4, -1.4  # symmetric: alignment cannot help
    error = absolute_error(estimated, true)
    np.testing.assert_allclose(error.per_frame, [0.4, 0.4, 0, 0], atol=1e-12)
    assert error.mean == pytest.approx(0.2)
    assert error.rmse == pytest.approx(np.sqrt(0.08))
    assert error.median == pytest.approx(0.2) and error.maximum == pytest.approx(0.4)


@settings(max_examples=30)
@given(count=st.integers(1, 12), seed=st.integers(0, 2**16), noise=st.floats(0.0, 0.5))
def test_alignment_is_a_rotation_and_no_nearby_one_is_better(count, seed, noise):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(count, 3))
    target = source @ se3.se3_exp(rng.normal(size=6))[:3, :3].T + rng.normal(size=3)
    target += noise * rng.normal(size=target.shape)
    scale, R, t = align(source, target)
    assert scale == 1.0
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)

    def cost(T: np.ndarray) -> float:
        return float(np.sum((target - source @ T[:3, :3].T - T[:3, 3]) ** 2))

    best = np.eye(4)
    best[:3, :3], best[:3, 3] = R, t
    for _ in range(5):
        assert cost(best) <= cost(se3.se3_exp(1e-2 * rng.normal(size=6)) @ best) + 1e-9


def test_mirrored_points_still_give_a_rotation(rng):
    source = rng.normal(size=(8, 3))
    _, R, _ = align(source, source * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_or_collinear_points_align_exactly(count):
    source = np.arange(count)[:, None] * np.array([[1.0, 2.0, 3.0]])
    target = source[:, [1, 2, 0]] + 5.0
    _, R, t = align(source, target)
    np.testing.assert_allclose(source @ R.T + t, target, atol=1e-9)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="align"):
        align(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(ValueError, match="align"):
        align(np.zeros((3, 3)), np.zeros((4, 3)))


def test_relative_error_sees_drift_and_not_position(rng):
    true = _poses(rng, 10)
    moved = _moved(true, se3.se3_exp(rng.normal(size=6)))
    same = relative_error(moved, true)
    assert same is not None and same.rmse < 1e-12
    drift = np.tile(np.eye(4), (5, 1, 1))
    drift[:, 0, 3] = 0.01 * np.arange(5)
    still = np.tile(np.eye(4), (5, 1, 1))
    one, two = relative_error(drift, still), relative_error(drift, still, step=2)
    assert one is not None and one.rmse == pytest.approx(0.01)
    assert two is not None and two.rmse == pytest.approx(0.02)
    assert relative_error(still[:1], still[:1]) is None
    with pytest.raises(ValueError, match="step"):
        relative_error(still, still, step=0)
