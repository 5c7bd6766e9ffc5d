# SPDX-License-Identifier: Apache-2.0
"""Trackers by name, and one of one's own."""

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.pipeline.tracking.tracker import TRACKERS, Tracker, TrackerContext, TrackerError, register_tracker
from ggwarp.types import Float64, Frame, MapSnapshot, TrackResult, Verdict

OFFICE = SyntheticOffice(scale=0.15)
CONFIG = SlamConfig(mapper=MapperConfig(iterations=2), policy="covisibility", use_identity=False)


class StandingStill:
    """A tracker without points: the camera stays where it began."""

    needs_gaussians = False

    def __init__(self, context: TrackerContext) -> None:
        self.context = context
        self.corrected: list[Float64] = []

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        self.T_wc = T_wc
        return TrackResult(T_wc, Verdict.CONVERGED)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        assert target.count == 0, "nobody gave points"
        return TrackResult(self.T_wc, Verdict.POOR, "it does not look")

    def on_pose_corrected(self, T_wc: Float64) -> None:
        self.corrected.append(T_wc)


def run(config: SlamConfig, device: str) -> Slam:
    slam = Slam(config, OFFICE.camera, OFFICE.camera, device=device)
    for i in range(3):
        slam.step(OFFICE[i])
    return slam


@pytest.fixture
def registered() -> Iterator[str]:
    register_tracker("still", StandingStill)
    yield "still"
    del TRACKERS["still"]


def test_a_registered_tracker_runs_by_its_name(device: str, registered: str) -> None:
    slam = run(dataclasses.replace(CONFIG, tracker=registered), device)
    first = OFFICE[0].T_wc
    assert first is not None
    assert all((r.T_wc == first).all() for r in slam.reports)
    assert [r.verdict for r in slam.reports] == [Verdict.CONVERGED, Verdict.POOR, Verdict.POOR]
    assert slam.reports[0].keyframe == "mapping" and slam.map.count > 0


def test_a_factory_is_a_tracker_too_and_is_told_of_the_run(device: str) -> None:
    made: list[StandingStill] = []

    def factory(context: TrackerContext) -> Tracker:
        made.append(StandingStill(context))
        return made[0]

    config = dataclasses.replace(CONFIG, tracker=factory)
    slam = run(config, device)
    context = made[0].context
    assert len(made) == 1 and context.config is config and context.camera is OFFICE.camera
    assert context.renderer.camera is OFFICE.camera and not context.monocular
    assert len(slam.reports) == 3 and not made[0].corrected, "poses are not fitted"


def test_a_tracker_itself_will_do(device: str) -> None:
    still = StandingStill(None)  # pyright: ignore[reportArgumentType]
    slam = run(dataclasses.replace(CONFIG, tracker=still), device)
    assert [r.verdict for r in slam.reports] == [Verdict.CONVERGED, Verdict.POOR, Verdict.POOR]


def test_corrected_poses_reach_a_tracker_that_works_in_turn(device: str) -> None:
    made: list[StandingStill] = []

    def factory(context: TrackerContext) -> Tracker:
        made.append(StandingStill(context))
        return made[0]

    fitted = dataclasses.replace(CONFIG.mapper, pose_rates=(1e-4, 1e-4))
    slam = run(dataclasses.replace(CONFIG, tracker=factory, mapper=fitted), device)
    assert slam.sequential_only, "so are the keyframes chosen"
    assert len(made[0].corrected) == len(slam.keyframe_indices) == 1
    np.testing.assert_allclose(made[0].corrected[0], slam.fitted_poses()[0])


def test_a_lost_map_is_begun_again_where_the_camera_was_last_seen(device: str) -> None:
    class GivesUp(StandingStill):
        needs_gaussians = True

        def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
            late = {0: np.diag([1.0, 1.0, 1.0, 1.0])}
            return TrackResult(self.T_wc, Verdict.LOST, "gone", earlier_poses=late, reinitialise=True)

    slam = run(dataclasses.replace(CONFIG, tracker=GivesUp), device)
    first = OFFICE[0].T_wc
    assert first is not None
    assert [r.reason for r in slam.reports] == ["", "gone", "the start was bad: a new map begins"]
    assert slam.keyframe_indices == [2] and (slam.reports[2].T_wc == first).all()
    assert (slam.fitted_poses()[0] == first).all(), "what was told of the first map is gone with it"


def test_points_are_needed_where_keyframes_go_by_overlap(device: str, registered: str) -> None:
    with pytest.raises(ValueError, match="covisibility"):
        run(dataclasses.replace(CONFIG, tracker=registered, policy="overlap"), device)


@pytest.mark.parametrize("name", ["gicp", "photometric", "hybrid", "ground-truth"])
def test_every_named_tracker_says_whether_it_looks_at_the_gaussians(name: str) -> None:
    slam = Slam(SlamConfig(tracker=name), OFFICE.camera, OFFICE.camera)
    assert slam.sequential_only == (name == "photometric")


def test_what_is_no_tracker_is_refused() -> None:
    with pytest.raises(TrackerError, match="gcip: no such tracker; choose one of gicp, photometric"):
        SlamConfig(tracker="gcip")
    for nothing in (None, 3, object()):
        with pytest.raises(TrackerError, match="no tracker; give a name"):
            SlamConfig(tracker=nothing)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TrackerError, match="no tracker"):
        register_tracker("bad", 5)  # pyright: ignore[reportArgumentType]
