# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.evaluation.trajectory import absolute_error
from ggwarp.geometry import se3
from ggwarp.pipeline.estimated_poses import EstimatedPoses
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.types import StepReport, Verdict

TWIST = np.array([0.1, 0.0, 0.02, 0.0, 0.05, 0.0])


def at(seconds: float) -> np.ndarray:
    return se3.se3_exp([1, 2, 3, 0.1, 0.2, 0.3]) @ se3.se3_exp(TWIST * seconds)


def step(index: int, seconds: float, *, lost: bool = False) -> StepReport:
    verdict, T_wc = (Verdict.LOST, at(0.0)) if lost else (Verdict.POOR, at(seconds))
    return StepReport(index, seconds, T_wc, verdict, "", 0.0, 0.0, "", 0.0, 0.0, 0, 0, 0.0)


def estimated(reports: list[StepReport], later: dict[int, np.ndarray] | None = None) -> dict[int, np.ndarray]:
    poses = EstimatedPoses()
    poses.by_frame = {r.index: r.T_wc for r in reports}
    return poses.final(reports, later or {})


def test_lost_frames_between_tracked_ones_are_interpolated_by_their_time() -> None:
    reports = [step(4, 1.0), step(5, 1.1, lost=True), step(9, 2.7, lost=True), step(10, 3.0)]
    poses = estimated(reports)
    assert list(poses) == [4, 5, 9, 10]
    for report in reports:
        np.testing.assert_allclose(poses[report.index], at(report.timestamp), atol=1e-12)
    np.testing.assert_array_equal(reports[1].T_wc, at(0.0))  # what was reported stays


def test_lost_frames_at_either_end_stay_where_they_were_predicted() -> None:
    reports = [step(0, 1.0, lost=True), step(1, 2.0), step(2, 3.0), step(3, 4.0, lost=True)]
    poses = estimated(reports)
    assert all((poses[i] == at(0.0)).all() for i in (0, 3))
    only = [step(0, 1.0, lost=True), step(1, 2.0, lost=True)]
    assert all((pose == at(0.0)).all() for pose in estimated(only).values())


def test_poses_that_became_known_later_hold_the_others() -> None:
    reports = [step(0, 0.0), step(1, 1.0, lost=True), step(2, 2.0, lost=True), step(3, 3.0)]
    poses = estimated(reports, {2: at(4.0)})
    np.testing.assert_array_equal(poses[2], at(4.0))
    np.testing.assert_allclose(poses[1], at(2.0), atol=1e-12)


def test_clocks_that_stand_still_say_nothing() -> None:
    reports = [step(0, 1.0), step(1, 1.0, lost=True), step(2, 1.0)]
    np.testing.assert_array_equal(estimated(reports)[1], at(0.0))


def test_a_gap_in_the_depth_does_not_pull_the_trajectory(device: str) -> None:
    """Five frames of a USB hiccup: they stay lost, and the path is right to what the camera does in it."""
    office = SyntheticOffice(scale=0.1)
    slam = Slam(
        SlamConfig(mapper=MapperConfig(iterations=1), use_identity=False),
        *(office.camera, office.camera),
        device=device,
    )
    true = []
    for i in range(16):
        frame = office[i]
        assert frame.depth is not None and frame.T_wc is not None
        true.append(frame.T_wc)
        slam.step(dataclasses.replace(frame, depth=frame.depth * (not 5 <= i < 10)))
    assert [r.index for r in slam.reports if r.verdict is Verdict.LOST] == [5, 6, 7, 8, 9]
    assert slam.counts["frames_lost"] == 5
    live, final = [r.T_wc for r in slam.reports], slam.fitted_poses()
    error = absolute_error(np.stack([final[i] for i in range(16)]), np.stack(true)).rmse
    assert error < 0.2 * absolute_error(np.stack(live), np.stack(true)).rmse
