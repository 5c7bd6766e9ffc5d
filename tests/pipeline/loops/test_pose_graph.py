# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.pipeline.loops.pose_graph import MeasuredMotion, is_positive, optimise_poses

pytest.importorskip("gtsam", reason="no wheels for this Python")

N = 24
COVARIANCE = np.diag([0.01**2] * 3 + [0.01**2] * 3)


def circle():
    """A walk round a table, looking ahead."""
    poses = []
    for k in range(N):
        angle = 2.0 * np.pi * k / N
        T = np.eye(4)
        T[:3, :3] = se3.so3_exp([0.0, angle, 0.0])
        T[:3, 3] = [np.cos(angle), 0.0, -np.sin(angle)]
        poses.append(T)
    return np.stack(poses)


def motion(poses, a, b, error=None):
    T = se3.inverse(poses[a]) @ poses[b]
    return MeasuredMotion(a, b, T if error is None else T @ se3.se3_exp(error), COVARIANCE)


def drifting(truth):
    """Tracked motions that all err alike, and the poses they lead to."""
    motions = [motion(truth, k, k + 1, [0.01, 0, 0.005, 0, 0.01, 0]) for k in range(N - 1)]
    poses = [truth[0]]
    for m in motions:
        poses.append(poses[-1] @ m.T_ab)
    return np.stack(poses), motions


def errors(poses, truth):
    return np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)


def test_motions_that_agree_leave_poses_where_they_are():
    truth = circle()
    motions = [motion(truth, k, k + 1) for k in range(N - 1)] + [motion(truth, 0, N - 1)]
    np.testing.assert_allclose(optimise_poses(truth, motions), truth, atol=1e-9)


def test_a_loop_takes_the_drift_away():
    truth = circle()
    poses, motions = drifting(truth)
    loops = [motion(truth, 0, N - 1), motion(truth, 1, N - 2)]
    found = optimise_poses(poses, [*motions, *loops])
    assert errors(found, truth)[-1] < 0.2 * errors(poses, truth)[-1]
    np.testing.assert_allclose(found[0], poses[0], atol=1e-6)
    assert np.linalg.det(found[:, :3, :3]) == pytest.approx(np.ones(N))


def test_a_false_loop_is_outvoted():
    truth = circle()
    motions = [motion(truth, a, b) for a in range(N) for b in range(a + 1, min(a + 4, N))]
    motions += [motion(truth, 0, N - 1), motion(truth, 1, N - 2)]
    lie = motion(truth, 3, 15, [0.8, 0.3, 0, 0, 1.0, 0])
    assert errors(optimise_poses(truth, [*motions, lie]), truth).max() < 0.01


def test_one_slip_of_the_tracker_is_mended_where_it_was():
    truth = circle()
    motions = [motion(truth, k, k + 1, [0.3, 0, 0, 0, 0, 0] if k == 10 else None) for k in range(N - 1)]
    poses = [truth[0]]
    for m in motions:
        poses.append(poses[-1] @ m.T_ab)
    loops = [motion(truth, a, a + 4) for a in range(5, 10)]
    loops += [motion(truth, 2, N - 1), motion(truth, 5, N - 3)]
    found = optimise_poses(np.stack(poses), [*motions, *loops])
    assert errors(found, truth).max() < 0.03


def test_it_repeats_to_the_bit():
    poses, motions = drifting(circle())
    motions.append(motion(circle(), 0, N - 1))
    np.testing.assert_array_equal(optimise_poses(poses, motions), optimise_poses(poses, motions))


def test_only_information_that_fixes_all_of_a_motion_has_a_covariance():
    assert is_positive(np.diag([1.0, 2.0, 3.0, 1e3, 1e4, 1e5]))
    slides = np.diag([0.0, 2.0, 3.0, 1.0, 1.0, 1.0])
    for bad in (slides, slides + 1e-13, -np.eye(6), np.zeros((6, 6)), np.full((6, 6), np.nan)):
        assert not is_positive(bad)


def test_poses_that_are_fixed_pull_the_others():
    truth = circle()
    wrong = truth.copy()
    wrong[2:] = se3.se3_exp([0.1, 0, 0, 0, 0, 0]) @ wrong[2:]
    motions = [motion(truth, k, k + 1) for k in range(1, N - 1)]  # nothing links the first two
    solved = optimise_poses(wrong, motions, fixed=2)
    np.testing.assert_allclose(solved, truth, atol=1e-3)
