# SPDX-License-Identifier: Apache-2.0
"""The system without depth: it waits, begins, tracks, and begins again where that was wrong."""

import dataclasses

import numpy as np
import pytest

from ggwarp.config import monocular
from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.evaluation.trajectory import absolute_error
from ggwarp.pipeline.loops.pose_graph import solver_is_there
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.types import Frame, Verdict

OFFICE = SyntheticOffice(scale=0.2)

LAST = 9


def bare(index: int, at: int) -> Frame:
    """Frame ``index`` as one camera gives it, ``at`` that place in the sequence."""
    frame = dataclasses.replace(OFFICE[index], depth=None, mask=None, true_mask=None, T_wc=None)
    return dataclasses.replace(frame, index=at, timestamp=at / 30.0)


def made(device: str) -> Slam:
    return Slam(monocular(SlamConfig()), OFFICE.camera, OFFICE.camera, device=device)


def test_the_camera_is_followed_up_to_scale(device: str) -> None:
    slam = made(device)
    reports = [slam.step(bare(i, i)) for i in range(LAST + 1)]
    begun = next(i for i, r in enumerate(reports) if r.verdict is not Verdict.LOST)
    assert 1 <= begun <= 5 and "depth will come with motion" in reports[0].reason
    assert all(r.verdict is Verdict.CONVERGED for r in reports[begun:])
    assert slam.keyframe_indices[0] == begun and len(slam.keyframe_indices) > 1
    poses = slam.fitted_poses()
    found, true = np.stack([poses[i] for i in range(LAST + 1)]), OFFICE.trajectory[: LAST + 1]
    error = absolute_error(found, true, with_scale=True)
    length = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    assert error.rmse < 0.03 * length, "frames before the start included"
    view = slam.render(poses[LAST])
    seen = view.opacity > 0.95
    assert seen.mean() > 0.6
    assert np.mean((view.rgb - OFFICE[LAST].rgb / 255.0)[seen] ** 2) < 10.0**-2.2


def test_a_start_that_soon_loses_the_camera_is_done_again(device: str) -> None:
    slam = made(device)
    shots = [*range(5), *range(60, 68)]
    reports = [slam.step(bare(index, at)) for at, index in enumerate(shots)]
    verdicts = [r.verdict for r in reports]
    # Lost or poor, by the order in which a device adds.
    assert verdicts[4] is Verdict.CONVERGED and verdicts[5] is not Verdict.CONVERGED
    assert verdicts[-1] is Verdict.CONVERGED
    assert "the start was bad: a new map begins" in [r.reason for r in reports]
    assert min(slam.keyframe_indices) > 5, "the first map is gone"
    poses = slam.fitted_poses()
    after = range(min(slam.keyframe_indices), len(shots))
    found = np.stack([poses[at] for at in after])
    true = np.stack([OFFICE.trajectory[shots[at]] for at in after])
    assert absolute_error(found, true, with_scale=True).rmse < 0.02


def test_a_second_run_is_the_same_to_the_bit(device: str) -> None:
    first, second = made(device), made(device)
    for index in range(6):
        a, b = (slam.step(bare(index, index)) for slam in (first, second))
        np.testing.assert_array_equal(a.T_wc, b.T_wc)
    assert first.can_refine
    np.testing.assert_array_equal(first.map.to_host().means, second.map.to_host().means)


def test_only_the_defaults_give_way_to_what_one_camera_needs() -> None:
    given = SlamConfig()
    changed = monocular(given)
    assert changed.mono and not changed.use_identity
    assert changed.policy == "covisibility"
    # Views are adjusted by their features, or poses are fitted with the map.
    assert any(changed.mapper.pose_rates) != solver_is_there()
    assert any(monocular(dataclasses.replace(given, loops=False)).mapper.pose_rates)
    own = dataclasses.replace(
        given, mapper=dataclasses.replace(given.mapper, rate_decay=7.0, pose_rates=(1e-5, 1e-5))
    )
    assert monocular(own).mapper.rate_decay == 7.0 and monocular(own).mapper.pose_rates == (1e-5, 1e-5)
    assert monocular(changed) == changed


@pytest.mark.parametrize("still", [True, False])
def test_without_parallax_there_is_no_map(device: str, still: bool) -> None:
    slam = made(device)
    reports = [slam.step(bare(0 if still else 40 * (at % 2), at)) for at in range(4)]
    assert all(r.verdict is Verdict.LOST for r in reports) and not slam.can_refine
