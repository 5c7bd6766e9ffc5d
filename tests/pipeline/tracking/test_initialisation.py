# SPDX-License-Identifier: Apache-2.0
"""A monocular start: it waits for parallax, and starts over where there is none to come."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.evaluation.trajectory import absolute_error
from ggwarp.geometry import se3
from ggwarp.pipeline.tracking import initialisation
from ggwarp.pipeline.tracking.initialisation import InitialisationConfig, MonocularInitialiser
from ggwarp.types import Frame

OFFICE = SyntheticOffice(scale=0.2)


def bare(index: int) -> Frame:
    """A frame as one camera gives it."""
    return dataclasses.replace(OFFICE[index], depth=None, mask=None, true_mask=None, T_wc=None)


def test_a_moving_camera_begins_with_depth_and_poses_up_to_scale() -> None:
    start = MonocularInitialiser(InitialisationConfig(), OFFICE.camera)
    T_first = se3.se3_exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    begun, index = None, -1
    while begun is None and index < 8:
        index += 1
        begun = start.add(bare(index), T_first)
        assert (begun is None) == bool(index < 2 or begun is None)
    assert begun is not None and index >= 2 and start.restarts == 0
    assert sorted(begun.poses) == list(range(index + 1))
    np.testing.assert_array_equal(begun.poses[0], T_first)
    np.testing.assert_array_equal(begun.poses[index], begun.T_wc)

    true_depth = OFFICE[index].depth
    assert true_depth is not None
    scale = np.median(true_depth / begun.depth)
    assert np.median(np.abs(scale * begun.depth / true_depth - 1.0)) < 0.08
    assert 1.5 < np.median(begun.depth) < 2.5

    found = np.stack([se3.inverse(T_first) @ begun.poses[i] for i in range(index + 1)])
    true = np.stack([se3.inverse(OFFICE.trajectory[0]) @ OFFICE.trajectory[i] for i in range(index + 1)])
    found[:, :3, 3] *= scale
    length = np.linalg.norm(true[-1, :3, 3])
    assert absolute_error(found, true).rmse < 0.1 * length
    assert np.linalg.norm(se3.so3_log(found[-1, :3, :3].T @ true[-1, :3, :3])) < np.radians(0.6)


def test_a_still_camera_waits_then_starts_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(initialisation, "PATIENCE", 4)
    start = MonocularInitialiser(InitialisationConfig(), OFFICE.camera)
    still = bare(0)
    for _ in range(4):
        assert start.add(still, np.eye(4)) is None
    assert start.restarts == 0 and start.waiting_for
    assert start.add(still, np.eye(4)) is None
    assert start.restarts == 1 and start.waiting_for.endswith("starting over")


def test_a_cut_starts_over_and_begins_after_it() -> None:
    start = MonocularInitialiser(InitialisationConfig(), OFFICE.camera)
    assert start.add(bare(0), np.eye(4)) is None
    assert start.add(bare(60), np.eye(4)) is None
    assert start.restarts == 1
    begun = None
    for index in range(61, 68):
        begun = begun or start.add(bare(index), np.eye(4))
    assert begun is not None and min(begun.poses) == 60
