# SPDX-License-Identifier: Apache-2.0
"""Information on a pose: what it says of the position, and what a random motion leaves of it."""

import numpy as np
import pytest

from ggwarp.geometry.uncertainty import loosened, position_std, semidefinite


def test_the_largest_deviation_of_the_position(rng: np.random.Generator) -> None:
    A = rng.normal(size=(6, 6))
    covariance = A @ A.T + np.eye(6)
    expected = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    assert position_std(np.linalg.inv(covariance)) == pytest.approx(expected)


@pytest.mark.parametrize("information", [np.zeros((6, 6)), np.diag([1.0, 1, 0, 1, 1, 1])])
def test_a_position_that_nothing_fixes_is_anywhere(information: np.ndarray) -> None:
    assert position_std(information) == float("inf")


def test_a_random_motion_adds_its_covariance(rng: np.random.Generator) -> None:
    A = rng.normal(size=(6, 6))
    information = A @ A.T + np.eye(6)
    motion = 0.1**2 * np.diag([1.0] * 3 + [4.0] * 3)
    expected = np.linalg.inv(np.linalg.inv(information) + motion)
    np.testing.assert_allclose(loosened(information, 0.1), expected, rtol=1e-9)
    assert loosened(information, 0.0) is information
    # What is not known at all stays unknown.
    blind = np.diag([1.0, 0, 1, 1, 1, 1])
    assert loosened(blind, 0.1)[1, 1] == pytest.approx(0.0, abs=1e-9)


def test_less_than_nothing_is_nothing(rng: np.random.Generator) -> None:
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    values = np.array([3.0, 2, 1, 0.5, -0.5, -2])
    expected = (axes * np.maximum(values, 0.0)) @ axes.T
    np.testing.assert_allclose(semidefinite((axes * values) @ axes.T), expected, atol=1e-12)
