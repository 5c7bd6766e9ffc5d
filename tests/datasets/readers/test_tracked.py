# SPDX-License-Identifier: Apache-2.0
"""What each reader opens is tracked and mapped, and the estimate agrees with where the camera was."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from every_layout import FRAMES, KINDS, WITHOUT_TRUTH, place
from ggwarp.datasets.plan.sequence_plan import plan_sequence
from ggwarp.geometry import se3
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.pipeline.tracking.gicp import GicpConfig
from ggwarp.types import Float64, Verdict
from phone_recordings import opened
from recorded_scene import pose

CONFIG = SlamConfig(gicp=GicpConfig(points=400), mapper=MapperConfig(iterations=2), use_identity=False)
"""No more points than the smallest depth has readings, as with pictures of a usual size."""


def assert_moves_alike(poses: list[Float64], others: list[Float64]) -> None:
    """Check that cameras go the same way from their first poses on, to 2 cm and 0.6 degrees."""
    for T_wc, other in zip(poses[1:], others[1:], strict=True):
        motion, expected = se3.inverse(poses[0]) @ T_wc, se3.inverse(others[0]) @ other
        wrong = se3.se3_log(se3.inverse(expected) @ motion)
        assert np.linalg.norm(wrong[:3]) < 0.02 and np.degrees(np.linalg.norm(wrong[3:])) < 0.6


@pytest.mark.parametrize("name", KINDS)
def test_what_a_reader_opens_is_tracked(tmp_path: Path, name: str) -> None:
    """From frame to frame the camera moves by 54 mm and turns by 3.5 degrees."""
    KINDS[name](tmp_path)
    dataset = opened(place(tmp_path))
    assert not plan_sequence(dataset).warnings
    frames = [dataset[i] for i in range(FRAMES)]
    slam = Slam(CONFIG, dataset.camera, dataset.camera, device="cpu")
    for frame in frames:
        slam.step(frame)
    assert {report.verdict for report in slam.reports} == {Verdict.CONVERGED} and slam.map.count > 100
    estimated = [report.T_wc for report in slam.reports]
    assert_moves_alike(estimated, [pose(i) for i in range(FRAMES)])
    told = [frame.T_wc for frame in frames if frame.T_wc is not None]
    assert len(told) == (0 if name in WITHOUT_TRUTH else FRAMES)
    if told:
        assert_moves_alike(estimated, told)


@pytest.mark.parametrize("name", ["nerfstudio", "colmap-text", "colmap-binary"])
def test_poses_are_taken_as_they_are_given(tmp_path: Path, name: str) -> None:
    KINDS[name](tmp_path)
    dataset = opened(place(tmp_path))
    config = replace(CONFIG, tracker="ground-truth")
    slam = Slam(config, dataset.camera, dataset.camera, device="cpu")
    for i in range(FRAMES):
        frame = dataset[i]
        assert frame.T_wc is not None
        np.testing.assert_allclose(slam.step(frame).T_wc, frame.T_wc, atol=1e-9)
    assert slam.map.count > 100
