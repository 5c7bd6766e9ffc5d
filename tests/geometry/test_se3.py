# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry import se3


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 0.3, 3.0])
def test_logarithm_undoes_exponential(size: float, rng: np.random.Generator) -> None:
    direction = rng.normal(size=6)
    direction[3:] /= np.linalg.norm(direction[3:])
    xi = size * direction
    np.testing.assert_allclose(se3.se3_log(se3.se3_exp(xi)), xi, rtol=1e-9, atol=1e-14)


def test_exponential_is_the_matrix_exponential(rng: np.random.Generator) -> None:
    linalg = pytest.importorskip("scipy.linalg")
    xi = rng.normal(size=6)
    twist = np.zeros((4, 4))
    twist[:3, :3] = se3.hat(xi[3:])
    twist[:3, 3] = xi[:3]
    np.testing.assert_allclose(se3.se3_exp(xi), linalg.expm(twist), atol=1e-12)


def test_adjoint_moves_a_twist_through_a_motion(rng: np.random.Generator) -> None:
    T, xi = se3.se3_exp(rng.normal(size=6)), rng.normal(size=6)
    np.testing.assert_allclose(
        se3.se3_exp(se3.adjoint(T) @ xi), T @ se3.se3_exp(xi) @ se3.inverse(T), atol=1e-12
    )


def test_interpolation_turns_and_moves_at_one_rate(rng: np.random.Generator) -> None:
    T, xi = se3.se3_exp(rng.normal(size=6)), 0.3 * rng.normal(size=6)
    for share in (0.0, 0.25, 1.0):
        found = se3.interpolate(T, T @ se3.se3_exp(xi), share)
        np.testing.assert_allclose(found, T @ se3.se3_exp(share * xi), atol=1e-12)


def test_half_turns_keep_their_axis() -> None:
    R = se3.so3_exp([np.pi, 0.0, 0.0])
    np.testing.assert_allclose(np.abs(se3.so3_log(R)), [np.pi, 0.0, 0.0], atol=1e-7)


def test_quaternions_are_w_first_and_round_trip(rng: np.random.Generator) -> None:
    np.testing.assert_allclose(se3.quat_from_matrix(np.eye(3)), [1, 0, 0, 0], atol=1e-12)
    R = se3.so3_exp(rng.normal(size=3))
    np.testing.assert_allclose(se3.matrix_from_quat(se3.quat_from_matrix(R)), R, atol=1e-12)


def test_orthonormalised_returns_a_rotation(rng: np.random.Generator) -> None:
    T = se3.se3_exp(rng.normal(size=6))
    noisy = T.copy()
    noisy[:3, :3] += 1e-3 * rng.normal(size=(3, 3))
    R = se3.orthonormalised(noisy)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R, T[:3, :3], atol=5e-3)
