# SPDX-License-Identifier: Apache-2.0
"""What each reader opens is tracked and mapped, and the estimate agrees with where the camera was."""

from pathlib import Path

import numpy as np
import pytest

from every_layout import FRAMES, KINDS, place
from ggwarp.datasets.plan.sequence_plan import plan_sequence
from ggwarp.geometry import se3
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.pipeline.tracking.gicp import GicpConfig
from ggwarp.types import Verdict
from phone_recordings import opened
from recorded_scene import pose

CONFIG = SlamConfig(gicp=GicpConfig(points=400), mapper=MapperConfig(iterations=2), use_identity=False)
"""No more points than the smallest depth has readings, as with pictures of a usual size."""


@pytest.mark.parametrize("name", KINDS)
def test_what_a_reader_opens_is_tracked(tmp_path: Path, name: str) -> None:
    """From frame to frame the camera moves by 54 mm and turns by 3.5 degrees; its truth is not looked at."""
    KINDS[name](tmp_path)
    dataset = opened(place(tmp_path))
    assert not plan_sequence(dataset).warnings
    slam = Slam(CONFIG, dataset.camera, dataset.camera, device="cpu")
    for i in range(FRAMES):
        slam.step(dataset[i])
    first, *others = (report.T_wc for report in slam.reports)
    assert {report.verdict for report in slam.reports} == {Verdict.CONVERGED} and slam.map.count > 100
    for i, T_wc in enumerate(others, 1):
        moved, estimated = se3.inverse(pose(0)) @ pose(i), se3.inverse(first) @ T_wc
        wrong = se3.se3_log(se3.inverse(moved) @ estimated)
        assert np.linalg.norm(wrong[:3]) < 0.02 and np.degrees(np.linalg.norm(wrong[3:])) < 0.6
