# SPDX-License-Identifier: Apache-2.0
"""Similarities between views, and the graph that spreads a lost scale."""

import numpy as np
import pytest

from ggwarp.geometry import se3, sim3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.similarity_graph import (
    MeasuredSimilarity,
    align_similarity,
    optimise_similarities,
    similarities,
)

pytest.importorskip("gtsam", reason="no wheels for this Python")

CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
S_AB = sim3.similarity(se3.se3_exp([0.2, -0.1, 0.1, 0.05, 0.2, -0.1]), 1.7)
N = 24
DEVIATIONS = (0.01, 0.02, 0.02)


def matched(rng, n):
    a = np.stack([rng.uniform(-1, 1, n), rng.uniform(-0.8, 0.8, n), rng.uniform(2, 4, n)], axis=1)
    return a, se3.transform_points(np.linalg.inv(S_AB), a)


def test_exact_points_give_the_exact_similarity(rng):
    a, b = matched(rng, 30)
    found, inliers = align_similarity(CAMERA, a, b, seed=(1,))
    np.testing.assert_allclose(found, S_AB, atol=1e-9)
    assert inliers.all()
    np.testing.assert_allclose(similarities(a, b), S_AB, atol=1e-9)


def test_false_matches_are_left_out(rng):
    a, b = matched(rng, 60)
    b[40:] = b[rng.permutation(20) + 40] + rng.uniform(0.3, 0.6, (20, 3))
    b[:40] *= 1.0 + 0.003 * rng.standard_normal((40, 1))
    found, inliers = align_similarity(CAMERA, a, b, seed=(1,))
    assert inliers[:40].mean() > 0.9 and not inliers[40:].any()
    assert abs(sim3.split(found)[1] / 1.7 - 1.0) < 0.01


def test_a_mirror_image_is_no_similarity(rng):
    a, b = matched(rng, 30)
    found = align_similarity(CAMERA, a, b * (-1.0, 1.0, 1.0), seed=(1,))
    assert found is None or found[1].sum() < 10


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_points_say_nothing(rng, n):
    assert align_similarity(CAMERA, *matched(rng, n), seed=(1,)) is None


def walk(growth):
    """Return true poses round a table, and those of a tracker whose steps grow by ``growth`` each time."""
    truth = []
    for angle in 2.0 * np.pi * np.arange(N) / N:
        T = np.eye(4)
        T[:3, :3] = se3.so3_exp([0.0, angle, 0.0])
        T[:3, 3] = [np.cos(angle), 0.0, -np.sin(angle)]
        truth.append(T)
    poses = [truth[0]]
    for k in range(N - 1):
        step = se3.inverse(truth[k]) @ truth[k + 1]
        step[:3, 3] *= growth**k
        poses.append(poses[-1] @ step)
    return np.stack(truth), np.stack(poses)


def test_a_lost_scale_is_spread_over_the_way():
    truth, poses = walk(1.03)
    motions = [
        MeasuredSimilarity(k, k + 1, se3.inverse(poses[k]) @ poses[k + 1], DEVIATIONS) for k in range(N - 1)
    ]
    loop = sim3.similarity(se3.inverse(truth[0]) @ truth[-1], 1.03 ** -(N - 1))
    found = optimise_similarities(poses, [*motions, MeasuredSimilarity(0, N - 1, loop, DEVIATIONS)])
    np.testing.assert_allclose(found[0], poses[0], atol=1e-6)
    off = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert off.max() < 0.03 and np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]) > 0.3
    scales = [sim3.split(S)[1] for S in found]
    # The loop counts as one step of N, and bears its share.
    np.testing.assert_allclose(scales, 1.03 ** (-np.arange(N) * (N - 1) / N), rtol=0.01)


def test_measurements_that_agree_leave_views_where_they_are():
    truth, _ = walk(1.0)
    motions = [
        MeasuredSimilarity(a, b, se3.inverse(truth[a]) @ truth[b], DEVIATIONS)
        for a, b in [*((k, k + 1) for k in range(N - 1)), (0, N - 1)]
    ]
    np.testing.assert_allclose(optimise_similarities(truth, motions), truth, atol=1e-7)
