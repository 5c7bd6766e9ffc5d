# SPDX-License-Identifier: Apache-2.0
"""Labels fused into the Gaussians that a view shows."""

import numpy as np
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.identity.label_fusion import fuse_labels, gather_evidence
from ggwarp.kernels.math import vec16

CAMERA = Camera(40, 30, 35.0, 36.0, 19.0, 14.5)
TOLERANCE = 0.02
T_CW = se3.se3_exp(np.array([0.1, -0.05, 0.2, 0.03, -0.02, 0.05]))


def scene(rng, n=1000):
    """Return means round the camera, a depth image, and labels; some of each are useless."""
    depth = rng.uniform(1.0, 3.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0.0
    u, v = rng.uniform(-5, CAMERA.width + 5, n), rng.uniform(-5, CAMERA.height + 5, n)
    rows = np.clip(np.rint(v), 0, CAMERA.height - 1).astype(int)
    columns = np.clip(np.rint(u), 0, CAMERA.width - 1).astype(int)
    z = depth[rows, columns] * rng.choice([0.9, 0.985, 1.0, 1.015, 1.1, -1.0], n)
    p = np.stack([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z], axis=1)
    means = (p - T_CW[:3, 3]) @ T_CW[:3, :3]
    means[0] = np.nan
    labels = rng.integers(-1, 7, depth.shape).astype(np.int32)
    return means.astype(np.float32), depth, labels


def shown(means, depth):
    """Yield (Gaussian, row, column) of those shown (float64)."""
    for i, p in enumerate(means.astype(np.float64) @ T_CW[:3, :3].T + T_CW[:3, 3]):
        if not p[2] > 0.05:
            continue
        column = int(np.floor(CAMERA.fx * p[0] / p[2] + CAMERA.cx + 0.5))
        row = int(np.floor(CAMERA.fy * p[1] / p[2] + CAMERA.cy + 0.5))
        inside = 0 <= row < CAMERA.height and 0 <= column < CAMERA.width
        if (
            inside
            and depth[row, column] > 0
            and abs(p[2] - depth[row, column]) <= TOLERANCE * depth[row, column]
        ):
            yield i, row, column


def arguments(means, depth, device):
    return {
        "count": len(means),
        "T_cw": wp.array(T_CW.astype(np.float32)[None], dtype=wp.mat44, device=device),
        "camera": intrinsics_of(CAMERA),
        "depth": wp.array(depth, dtype=float, device=device),
        "tolerance": TOLERANCE,
        "device": device,
    }


def test_labels_are_averaged_into_what_is_shown(rng, device):
    means, depth, labels = scene(rng)
    codes = rng.normal(size=(6, 16)).astype(np.float32)  # label 6 is one too many
    identities = rng.normal(size=(len(means), 16)).astype(np.float32)
    votes = rng.integers(0, 12, len(means)).astype(np.int32)
    on_device = wp.array(identities, dtype=vec16, device=device)
    votes_on_device = wp.array(votes, device=device)
    fuse_labels(
        wp.array(means, dtype=wp.vec3, device=device),
        labels=wp.array(labels, device=device),
        codes=wp.array(codes, dtype=vec16, device=device),
        limits=wp.array([8, 8, 3, 1, 8, 8], dtype=int, device=device),
        identities=on_device,
        votes=votes_on_device,
        **arguments(means, depth, device),
    )
    want, changed = identities.astype(np.float64), 0
    for i, row, column in shown(means, depth):
        label = labels[row, column]
        if 0 <= label < 6:
            n = min(votes[i], (8, 8, 3, 1, 8, 8)[label] - 1)
            want[i] += (codes[label] - want[i]) / (n + 1)
            votes[i], changed = n + 1, changed + 1
    assert changed > 100
    np.testing.assert_allclose(on_device.numpy(), want, atol=1e-5)
    np.testing.assert_array_equal(votes_on_device.numpy(), votes)


def test_the_majority_is_the_nearest_code(rng, device):
    codes = rng.normal(size=(20, 16)).astype(np.float32)
    means, depth = np.array([[0.0, 0.0, 2.0]], np.float32), np.full((30, 40), 2.0, np.float32)
    identities = wp.array(rng.normal(size=(1, 16)), dtype=vec16, device=device)
    votes = wp.zeros(1, dtype=int, device=device)
    common = arguments(means, depth, device)
    common["T_cw"] = wp.array(np.eye(4)[None], dtype=wp.mat44, device=device)
    for label in (3, 11, 11, 5, 11, 3, 11):
        fuse_labels(
            wp.array(means, dtype=wp.vec3, device=device),
            labels=wp.full((30, 40), label, dtype=int, device=device),
            codes=wp.array(codes, dtype=vec16, device=device),
            limits=wp.full(20, 8, dtype=int, device=device),
            identities=identities,
            votes=votes,
            **common,
        )
    assert votes.numpy()[0] == 7
    assert ((codes - identities.numpy()) ** 2).sum(axis=1).argmin() == 11


def test_evidence_is_the_most_votes_at_a_pixel(rng, device):
    means, depth, _ = scene(rng)
    means = np.concatenate([means, means])
    votes = rng.integers(0, 9, len(means)).astype(np.int32)
    evidence = wp.full(depth.shape, 77, dtype=int, device=device)
    gather_evidence(
        wp.array(means, dtype=wp.vec3, device=device),
        wp.array(votes, device=device),
        evidence=evidence,
        **arguments(means, depth, device),
    )
    want = np.zeros(depth.shape, int)
    for i, row, column in shown(means, depth):
        want[row, column] = max(want[row, column], votes[i])
    assert want.max() == 8
    np.testing.assert_array_equal(evidence.numpy(), want)


def test_a_lower_limit_wins_a_gaussian_over_at_once(rng, device):
    codes = rng.normal(size=(2, 16)).astype(np.float32)
    means, depth = np.array([[0.0, 0.0, 2.0]], np.float32), np.full((30, 40), 2.0, np.float32)
    common = arguments(means, depth, device)
    common["T_cw"] = wp.array(np.eye(4)[None], dtype=wp.mat44, device=device)
    identities = wp.array(codes[:1], dtype=vec16, device=device)
    votes = wp.full(1, 8, dtype=int, device=device)
    for _ in range(2):
        fuse_labels(
            wp.array(means, dtype=wp.vec3, device=device),
            labels=wp.full((30, 40), 1, dtype=int, device=device),
            codes=wp.array(codes, dtype=vec16, device=device),
            limits=wp.array([8, 2], dtype=int, device=device),
            identities=identities,
            votes=votes,
            **common,
        )
    np.testing.assert_allclose(identities.numpy()[0], 0.25 * codes[0] + 0.75 * codes[1], atol=1e-6)


def test_nothing_to_fuse(device):
    fuse_labels(
        wp.zeros(0, dtype=wp.vec3, device=device),
        labels=wp.zeros((30, 40), dtype=int, device=device),
        codes=wp.zeros(2, dtype=vec16, device=device),
        limits=wp.full(2, 8, dtype=int, device=device),
        identities=wp.zeros(0, dtype=vec16, device=device),
        votes=wp.zeros(0, dtype=int, device=device),
        **arguments(np.zeros((0, 3), np.float32), np.ones((30, 40), np.float32), device),
    )
