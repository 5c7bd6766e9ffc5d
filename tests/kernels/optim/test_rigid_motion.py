# SPDX-License-Identifier: Apache-2.0
"""Gaussians that move with their keyframes, against NumPy in float64."""

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.rigid_motion import move_gaussians


def arrays(rng, n):
    quats = rng.standard_normal((n, 4))
    return {
        "means": rng.standard_normal((n, 3)).astype(np.float32),
        "quats": (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        "log_scales": rng.standard_normal((n, 3)).astype(np.float32),
        "first": rng.standard_normal((n, 16)).astype(np.float32),
        "second": rng.uniform(0.0, 1.0, (n, 16)).astype(np.float32),
    }


def moved(values, motions, owners, device, count=None, scales=None):
    types = {"means": wp.vec3, "quats": wp.vec4, "log_scales": wp.vec3, "first": vec16, "second": vec16}
    on_device = {k: wp.array(v, dtype=types[k], device=device) for k, v in values.items()}
    move_gaussians(
        wp.array(np.asarray(motions, np.float32), dtype=wp.mat44, device=device),
        wp.array(np.ones(len(motions)) if scales is None else scales, dtype=float, device=device),
        keyframe_ids=wp.array(owners, dtype=wp.int32, device=device),
        **on_device,
        count=len(owners) if count is None else count,
        device=device,
    )
    return {k: v.numpy() for k, v in on_device.items()}


def product_matrix(q):
    """Of x -> q x."""
    return np.stack([se3_product(q, e) for e in np.eye(4)], axis=1)


def se3_product(a, b):
    v = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *v])


def test_gaussians_and_moments_turn_with_their_keyframe(device, rng):
    values, owners = arrays(rng, 300), rng.integers(0, 3, 300).astype(np.int32)
    motions = np.stack([se3.se3_exp(scale * rng.standard_normal(6)) for scale in (0.01, 1.0, 3.0)])
    found = moved(values, motions, owners, device)
    for i, k in enumerate(owners):
        R, Q = motions[k][:3, :3], product_matrix(se3.quat_from_matrix(motions[k][:3, :3]))
        first, second = values["first"][i].astype(np.float64), values["second"][i].astype(np.float64)
        np.testing.assert_allclose(
            found["means"][i], se3.transform_points(motions[k], values["means"][i][None])[0], atol=3e-6
        )
        np.testing.assert_allclose(
            se3.matrix_from_quat(found["quats"][i]),
            R @ se3.matrix_from_quat(values["quats"][i]),
            atol=3e-6,
        )
        np.testing.assert_allclose(found["first"][i, :3], R @ first[:3], atol=3e-6)
        np.testing.assert_allclose(found["first"][i, 3:7], Q @ first[3:7], atol=3e-6)
        np.testing.assert_allclose(found["second"][i, :3], R**2 @ second[:3], atol=3e-6)
        np.testing.assert_allclose(found["second"][i, 3:7], Q**2 @ second[3:7], atol=3e-6)
        np.testing.assert_array_equal(found["first"][i, 7:], values["first"][i, 7:])
        np.testing.assert_array_equal(found["second"][i, 7:], values["second"][i, 7:])


def test_what_grows_takes_sizes_and_moments_with_it(device, rng):
    values, owners = arrays(rng, 200), rng.integers(0, 2, 200).astype(np.int32)
    motions = np.stack([se3.se3_exp(rng.standard_normal(6)) for _ in range(2)])
    scales = np.array([0.4, 2.5])
    found, rigid = (
        moved(values, motions, owners, device, scales=scales),
        moved(values, motions, owners, device),
    )
    s = scales[owners][:, None]
    for k, motion in enumerate(motions):
        np.testing.assert_allclose(
            found["means"][owners == k],
            se3.transform_points(motion, scales[k] * values["means"][owners == k]),
            atol=2e-5,
        )
    np.testing.assert_array_equal(found["quats"], rigid["quats"])
    np.testing.assert_allclose(found["log_scales"], values["log_scales"] + np.log(s), atol=1e-6)
    np.testing.assert_allclose(found["first"][:, :3], rigid["first"][:, :3] / s, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found["second"][:, :3], rigid["second"][:, :3] / s**2, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(found["first"][:, 3:], rigid["first"][:, 3:])


def test_a_quaternions_gradient_turns_as_its_moment_does(rng):
    """Finite differences: a loss in the keyframe's frame, before and after the keyframe is moved."""
    q, w, R = rng.standard_normal(4), rng.standard_normal(4), se3.so3_exp(rng.standard_normal(3))
    Q = product_matrix(se3.quat_from_matrix(R))

    def gradient(loss, at):
        h = 1e-6
        return np.array([(loss(at + h * e) - loss(at - h * e)) / (2 * h) for e in np.eye(4)])

    before = gradient(lambda x: np.sin(w @ x), q)
    after = gradient(lambda x: np.sin(w @ (Q.T @ x)), Q @ q)
    np.testing.assert_allclose(after, Q @ before, atol=1e-8)


def test_what_is_not_moved_keeps_its_bits(device, rng):
    values, owners = arrays(rng, 50), np.tile(np.int32([0, 1]), 25)
    values["quats"] = np.tile(np.float32([0.5, -0.5, 0.5, 0.5]), (50, 1))
    found = moved(values, np.stack([np.eye(4), se3.se3_exp([1, 0, 0, 0, 1, 0])]), owners, device, count=49)
    still = owners == 0
    still[49] = True
    for name, before in values.items():
        np.testing.assert_array_equal(found[name][still], before[still])
    assert (found["means"][~still] != values["means"][~still]).any(axis=1).all()


@pytest.mark.parametrize("n", [0, 1])
def test_few(device, rng, n):
    values = arrays(rng, n)
    found = moved(values, np.eye(4)[None], np.zeros(n, np.int32), device)
    np.testing.assert_array_equal(found["means"], values["means"])
