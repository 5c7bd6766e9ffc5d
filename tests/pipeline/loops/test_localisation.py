# SPDX-License-Identifier: Apache-2.0
"""Recordings that begin somewhere in the map of an earlier run of the built-in office."""

import dataclasses

import numpy as np
import pytest

from ggwarp.config import preset_config
from ggwarp.datasets import FrameReader
from ggwarp.datasets.built_in.synthetic import SyntheticOffice, SyntheticWall
from ggwarp.geometry import se3
from ggwarp.map.gaussians import join
from ggwarp.pipeline.loops import localisation
from ggwarp.pipeline.loops.localisation import NotFoundError, frame_of, view_index
from ggwarp.pipeline.slam import Slam
from ggwarp.results.saved_run import load_run
from ggwarp.types import Frame, Rendered, Verdict

CONFIG = dataclasses.replace(preset_config("fast").slam, loops=False)
OFFICE = SyntheticOffice(scale=0.2)


def system(scene, earlier=None, config=CONFIG):
    reader = FrameReader(scene, range(len(scene)))
    return Slam(config, reader.camera, reader.sensor_camera, device="cpu", earlier=earlier)


def without_truth(frame):
    return dataclasses.replace(frame, T_wc=None)


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    """The first half of the turn, every second frame; its world is the truth's."""
    slam, folder = system(OFFICE), tmp_path_factory.mktemp("earlier") / "run"
    for index in range(0, 60, 2):
        slam.step(OFFICE[index])
    slam.save(folder)
    return load_run(folder)


def errors(T_wc, true):
    motion = se3.se3_log(se3.inverse(T_wc) @ true)
    return np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])


@pytest.mark.parametrize("index", [1, 13, 27, 39, 55])
def test_frames_are_found_wherever_they_are(earlier, index) -> None:
    slam = system(OFFICE, earlier)
    frame = OFFICE[index]
    result = slam.track_frame(without_truth(frame)).result
    distance, angle = errors(result.T_wc, frame.T_wc)
    assert result.verdict is Verdict.CONVERGED and distance < 0.01 and angle < 0.005
    assert result.overlap > 0.8, "it is known how much of it is new"
    assert slam.localiser.place.frame == index and slam.localiser.failure is None


def test_from_random_poses_beside_the_path(earlier, rng) -> None:
    for index in (7, 25, 43):
        twist = np.concatenate([rng.uniform(-0.15, 0.15, 3), rng.uniform(-0.12, 0.12, 3)])
        true = OFFICE[index].T_wc @ se3.se3_exp(twist)
        rgb, depth, _ = OFFICE.render(true)
        result = system(OFFICE, earlier).track_frame(Frame(index, 0.0, rgb, depth)).result
        distance, angle = errors(result.T_wc, true)
        assert result.verdict is Verdict.CONVERGED and distance < 0.01 and angle < 0.01


def test_another_camera_is_found_in_the_same_map(earlier) -> None:
    other = SyntheticOffice(scale=0.3)
    frame = other[21]
    result = system(other, earlier).track_frame(without_truth(frame)).result
    assert result.verdict is Verdict.CONVERGED and errors(result.T_wc, frame.T_wc)[0] < 0.01


def test_another_room_is_not_taken_for_it(earlier, monkeypatch) -> None:
    wall = SyntheticWall(scale=0.2)
    slam = system(wall, earlier)
    before = slam.map_arrays()
    for index in range(0, 12, 4):
        report = slam.step(wall[index])
        assert report.verdict is Verdict.LOST and report.keyframe == "" and report.mapping_iterations == 0
        assert "not yet found in" in report.reason
    np.testing.assert_array_equal(slam.map_arrays().means, before.means)
    assert not slam.keyframe_indices and "none of 3 frames was found" in str(slam.localiser.failure)
    monkeypatch.setattr(localisation, "_PATIENCE", 4)
    with pytest.raises(NotFoundError, match="none of 4 frames was found"):
        slam.step(wall[12])


def test_a_place_that_is_there_twice_is_not_guessed(earlier) -> None:
    away = se3.se3_exp([30.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    g = earlier.gaussians
    copy = dataclasses.replace(g, means=(g.means + np.float32([30.0, 0.0, 0.0])))
    twice = dataclasses.replace(
        earlier, gaussians=join(g, copy), poses=np.concatenate([earlier.poses, away @ earlier.poses])
    )
    assert system(OFFICE, twice).track_frame(OFFICE[13]).result.verdict is Verdict.LOST


def test_frames_before_the_first_that_is_found_stay_near_it(earlier) -> None:
    slam = system(OFFICE, earlier)
    dark = dataclasses.replace(OFFICE[12], rgb=np.zeros_like(OFFICE[12].rgb))
    slam.step(dark)
    report = slam.step(OFFICE[13])
    assert [r.verdict for r in slam.reports] == [Verdict.LOST, Verdict.CONVERGED]
    assert np.isnan(slam.reports[0].position_std_cm) and report.position_std_cm == 0.0
    np.testing.assert_array_equal(slam.fitted_poses()[12], report.T_wc)


def test_a_render_has_depth_where_it_shows_one_surface() -> None:
    shape = (1, 4)
    opacity = np.float32([[1.0, 0.5, 1.0, 1.0]])
    depth, median = np.float32([[2.0, 1.0, 2.0, 0.0]]), np.float32([[2.02, 2.0, 3.0, 0.0]])
    frame = frame_of(Rendered(np.full((*shape, 3), 0.5, np.float32), depth, median, opacity), view_index(17))
    assert frame.index == -18 and view_index(frame.index) == 17 and frame.rgb.dtype == np.uint8
    np.testing.assert_array_equal(frame.depth, [[2.0, 0.0, 0.0, 0.0]])


def test_what_has_been_taken_away_since_goes_and_what_is_behind_it_comes(earlier) -> None:
    cabinet, printer = 34, 35
    emptied = SyntheticOffice(scale=0.2, without=(cabinet, printer))
    slam = system(emptied, earlier)
    before = {record.id: record.count for record in slam.objects({})}
    assert before[cabinet] > 100 and before[printer] > 50
    errors = []
    for index in range(1, 31, 2):
        slam.step(emptied[index])
    for index in range(1, 31, 2):
        full, empty = OFFICE[index], emptied[index]
        taken = np.isin(full.mask, (cabinet, printer)) & (full.mask != empty.mask)
        shown = slam.render(slam.fitted_poses()[index]).surface_depth
        errors.append(np.abs(shown - empty.depth)[taken])
    assert np.median(np.concatenate(errors)) < 0.05, "it was half a metre before"
    after = {record.id: record.count for record in slam.objects({})}
    assert after.get(cabinet, 0) < 0.1 * before[cabinet] and after.get(printer, 0) < 0.1 * before[printer]
    others = [i for i, count in before.items() if count > 100 and i not in (cabinet, printer)]
    assert all(after[i] > 0.5 * before[i] for i in others), "what stands still stays"
