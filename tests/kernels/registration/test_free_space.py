# SPDX-License-Identifier: Apache-2.0
"""What views say of each other's points, against NumPy in float64."""

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.registration.free_space import IN_PLACE, THROUGH, cast_votes

CAMERA = Camera(64, 48, 55.0, 56.0, 31.2, 23.9)
TOLERANCE = 0.05


def said(depth, nearest, pairs, motions, stride, device):
    depth, nearest = (np.asarray(a, np.float32) for a in (depth, nearest))
    out = wp.full((len(pairs), *depth.shape[1:]), 9, dtype=wp.uint8, device=device)
    cast_votes(
        wp.array(depth, dtype=wp.float32, device=device),
        wp.array(nearest, dtype=wp.float32, device=device),
        wp.array(np.asarray(pairs, np.int32).reshape(-1, 2), dtype=wp.int32, device=device),
        wp.array(np.asarray(motions, np.float32).reshape(-1, 4, 4), dtype=wp.float32, device=device),
        intrinsics_of(CAMERA),
        stride=stride,
        tolerance=TOLERANCE,
        said=out,
        device=device,
    )
    return out.numpy()


def reference(depth, nearest, subject, witness, T, stride):
    """Return what is said of each point, and where float32 may round to another pixel or side."""
    h, w = depth.shape[1:]
    rows, columns = np.mgrid[:h, :w] * stride
    z = depth[subject].astype(np.float64)
    p = se3.transform_points(T, CAMERA.back_project(columns, rows, z).reshape(-1, 3)).reshape(h, w, 3)
    i, j, inside = CAMERA.pixels_of(p)
    pixels, _ = CAMERA.project(p)
    close, far = depth[witness][i // stride, j // stride], nearest[witness][i // stride, j // stride]
    ahead = p[..., 2]
    there = inside & (z > 0.0)
    out = np.zeros((h, w), np.uint8)
    out[there & (np.abs(close - ahead) < TOLERANCE * ahead)] = IN_PLACE
    out[there & (far > ahead * (1.0 + TOLERANCE))] = THROUGH
    unsure = (np.abs(np.abs(pixels - np.floor(pixels)) - 0.5) < 1e-3).any(axis=-1)
    for limit in (np.abs(close - ahead) - TOLERANCE * ahead, far - ahead * (1.0 + TOLERANCE), ahead - 0.05):
        unsure |= np.abs(limit) < 1e-5
    return out, unsure & (z > 0.0)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_it_is_what_numpy_says(device: str, stride: int) -> None:
    rng = np.random.default_rng(stride)
    shape = (4, -(-CAMERA.height // stride), -(-CAMERA.width // stride))
    depth = rng.uniform(1.0, 1.4, shape)
    depth[rng.random(shape) < 0.2] = 0.0
    depth[3] = 0.0
    depth = depth.astype(np.float32)
    nearest = np.where(rng.random(shape) < 0.5, depth, np.float32(0.0))
    pairs = [(0, 1), (1, 0), (2, 1), (3, 0), (0, 3), (2, 2)]
    motions = [se3.se3_exp(rng.normal(size=6) * 0.08).astype(np.float32) for _ in pairs]
    motions[5] = np.eye(4, dtype=np.float32)
    motions[2] = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)  # looks the other way
    found = said(depth, nearest, pairs, motions, stride, device)
    for k, ((subject, witness), T) in enumerate(zip(pairs, motions, strict=True)):
        expected, unsure = reference(depth, nearest, subject, witness, T.astype(np.float64), stride)
        np.testing.assert_array_equal(found[k][~unsure], expected[~unsure])
        assert unsure.mean() < 0.05
    assert {0, IN_PLACE, THROUGH} <= set(np.unique(found[0]).tolist())
    assert not found[2].any() and not found[3].any() and not found[4].any()
    assert (found[5][depth[2] > 0.0] == IN_PLACE).all(), "a view finds its own points in place"


def test_nobody_says_anything(device: str) -> None:
    depth = np.ones((1, 48, 64), np.float32)
    assert said(depth, depth, [], [], 1, device).shape == (0, 48, 64)


def test_what_is_not_a_number_says_nothing(device: str) -> None:
    depth = np.ones((2, 48, 64), np.float32)
    depth[0, 10, 10], depth[1, 12:20] = np.nan, np.nan
    T = np.eye(4)
    T[2, 3] = np.nan
    found = said(depth, depth, [(0, 1), (1, 0), (0, 1)], [np.eye(4), np.eye(4), T], 1, device)
    assert found[0, 10, 10] == 0 and not found[0, 12:20].any() and not found[1, 12:20].any()
    assert found[0, :10].all() and not found[2].any()
