# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp import lie


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 0.3, 3.0])
def test_logarithm_undoes_exponential(size: float, rng: np.random.Generator) -> None:
    direction = rng.normal(size=6)
    direction[3:] /= np.linalg.norm(direction[3:])
    xi = size * direction
    np.testing.assert_allclose(lie.se3_log(lie.se3_exp(xi)), xi, rtol=1e-9, atol=1e-14)


def test_exponential_is_the_matrix_exponential(rng: np.random.Generator) -> None:
    linalg = pytest.importorskip("scipy.linalg")
    xi = rng.normal(size=6)
    twist = np.zeros((4, 4))
    twist[:3, :3] = lie.hat(xi[3:])
    twist[:3, 3] = xi[:3]
    np.testing.assert_allclose(lie.se3_exp(xi), linalg.expm(twist), atol=1e-12)


def test_adjoint_moves_a_twist_through_a_motion(rng: np.random.Generator) -> None:
    T, xi = lie.se3_exp(rng.normal(size=6)), rng.normal(size=6)
    np.testing.assert_allclose(
        lie.se3_exp(lie.adjoint(T) @ xi), T @ lie.se3_exp(xi) @ lie.inverse(T), atol=1e-12
    )


def test_half_turns_keep_their_axis() -> None:
    R = lie.so3_exp([np.pi, 0.0, 0.0])
    np.testing.assert_allclose(np.abs(lie.so3_log(R)), [np.pi, 0.0, 0.0], atol=1e-7)


def test_quaternions_are_w_first_and_round_trip(rng: np.random.Generator) -> None:
    np.testing.assert_allclose(lie.quat_from_matrix(np.eye(3)), [1, 0, 0, 0], atol=1e-12)
    R = lie.so3_exp(rng.normal(size=3))
    np.testing.assert_allclose(lie.matrix_from_quat(lie.quat_from_matrix(R)), R, atol=1e-12)


def test_orthonormalised_returns_a_rotation(rng: np.random.Generator) -> None:
    T = lie.se3_exp(rng.normal(size=6))
    noisy = T.copy()
    noisy[:3, :3] += 1e-3 * rng.normal(size=(3, 3))
    R = lie.orthonormalised(noisy)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R, T[:3, :3], atol=5e-3)
