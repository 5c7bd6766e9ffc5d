# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np
import pytest

from ggwarp.geometry import se3, sim3
from ggwarp.geometry.pose_correction import PoseCorrection

MOTION = se3.se3_exp([0.3, -0.2, 0.5, 0.1, 0.7, -0.4])


@pytest.mark.parametrize("scale", [0.3, 0.999, 4.0])
def test_a_similarity_is_its_motion_after_its_scale(scale, rng):
    points = rng.standard_normal((5, 3))
    S = sim3.similarity(MOTION, scale)
    np.testing.assert_allclose(
        se3.transform_points(S, points), se3.transform_points(MOTION, scale * points), atol=1e-12
    )
    T, found = sim3.split(S)
    np.testing.assert_allclose(T, MOTION, atol=1e-12)
    assert found == pytest.approx(scale, rel=1e-12)


def test_a_rigid_motion_keeps_its_bits():
    T, scale = sim3.split(MOTION)
    assert scale == 1.0
    np.testing.assert_array_equal(T, MOTION)
    end = se3.se3_exp([1, 2, 3, 0.2, 0, 0])
    np.testing.assert_array_equal(sim3.interpolate(MOTION, end, 0.3), se3.interpolate(MOTION, end, 0.3))


def test_a_pose_goes_with_the_world_and_stays_a_pose():
    S, T_wc = sim3.similarity(MOTION, 2.5), se3.se3_exp([1, 0, -1, 0.4, 0, 0.1])
    moved = sim3.moved_pose(S, T_wc)
    np.testing.assert_allclose(moved[:3, 3], se3.transform_points(S, T_wc[None, :3, 3])[0], atol=1e-12)
    np.testing.assert_allclose(moved[:3, :3], MOTION[:3, :3] @ T_wc[:3, :3], atol=1e-12)


def test_between_two_similarities_scale_and_motion_change_at_a_constant_rate():
    ends = np.stack([sim3.similarity(np.eye(4), 0.5), sim3.similarity(MOTION, 2.0)])
    correction = PoseCorrection((0, 4), ends)
    steps = correction.at([0, 1, 2, 3, 4])
    np.testing.assert_array_equal(steps[[0, 4]], ends)
    np.testing.assert_allclose(
        [sim3.split(S)[1] for S in steps], 0.5 * 4.0 ** np.linspace(0.0, 1.0, 5), rtol=1e-9
    )
    step = np.linalg.solve(steps[0], steps[1])
    for a, b in itertools.pairwise(steps):
        np.testing.assert_allclose(np.linalg.solve(a, b), step, atol=1e-9)
