# SPDX-License-Identifier: Apache-2.0
"""A walk round the built-in office by a tracker that loses its scale; poses are made up, pictures are not."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.evaluation.trajectory import absolute_error
from ggwarp.geometry import se3, sim3
from ggwarp.pipeline.loops.monocular_loops import MonocularLoops
from ggwarp.runtime.state import restore_into, state_of
from ggwarp.types import Frame, TrackResult, Verdict

pytest.importorskip("gtsam", reason="no wheels for this Python")

OFFICE = SyntheticOffice(scale=0.2)
STILL = np.eye(4)
GROWTH = 1.02
"""Each step is so many times too long, compared with the one before."""


@pytest.fixture(scope="module")
def shots():
    return {i: OFFICE[i] for i in range(0, 60, 2)}


class Walk:
    """Frames at made-up poses, which follow what is corrected, as a tracker's do."""

    def __init__(self, frames_a_shot=2):
        self._step = frames_a_shot
        self.loops = MonocularLoops(OFFICE.camera)
        self.true, self.estimated, self.closures = [], [], []
        self._scale = 1.0

    def go(self, shots, order, growth=GROWTH, verdict=Verdict.CONVERGED, slip=STILL):
        for i in order:
            shot, step = shots[i], len(self.true)
            T = np.eye(4)
            if step:
                motion = se3.inverse(self.true[-1]) @ shot.T_wc
                motion[:3, 3] *= self._scale
                self._scale *= growth
                T = self.estimated[-1] @ motion @ slip
            self.true.append(shot.T_wc)
            self.estimated.append(T)
            frame = Frame(self._step * step, step / 15.0, shot.rgb)
            if closure := self.loops.observe(frame, TrackResult(T, verdict)):
                self.closures.append(closure)
                motions = closure.correction.at(range(0, self._step * step + 1, self._step))
                pairs = zip(motions, self.estimated, strict=True)
                self.estimated = [sim3.moved_pose(S, E) for S, E in pairs]
                self._scale *= sim3.split(motions[-1])[1]
        return self

    @property
    def error(self):
        return absolute_error(np.stack(self.estimated), np.stack(self.true), with_scale=True).rmse


def test_scale_and_poses_do_not_drift(shots):
    order = range(0, 60, 2)
    walk = Walk().go(shots, order)
    drifting = np.tile(np.eye(4), (30, 1, 1))
    for k in range(1, 30):
        step = se3.inverse(walk.true[k - 1]) @ walk.true[k]
        step[:3, 3] *= GROWTH**k
        drifting[k] = drifting[k - 1] @ step
    uncorrected = absolute_error(drifting, np.stack(walk.true), with_scale=True).rmse
    assert walk.error < 0.02 and walk.error < 0.3 * uncorrected
    assert all(c.seen_before is None for c in walk.closures)
    np.testing.assert_array_equal(walk.estimated[0], np.eye(4))


def test_a_place_seen_again_brings_its_scale_back(shots, monkeypatch):
    """The window is kept so short, and the drift so large, that the loop alone can tell."""
    monkeypatch.setattr("ggwarp.pipeline.loops.monocular_loops._WINDOW", 3)
    order = [*range(0, 36, 2), *range(34, 5, -2)]
    walk = Walk().go(shots, order, growth=1.05)
    loops = [c for c in walk.closures if c.seen_before is not None]
    assert loops and all(c.seen_before < c.frame and c.moved > 0.0 for c in loops)
    assert walk.error < 0.02


def test_lost_frames_and_blank_pictures_say_nothing(shots):
    walk = Walk().go(shots, range(0, 20, 2), verdict=Verdict.LOST)
    assert not walk.closures
    blank = {i: dataclasses.replace(shot, rgb=np.full_like(shot.rgb, 90)) for i, shot in shots.items()}
    walk = Walk().go(blank, range(0, 20, 2), growth=1.0)
    np.testing.assert_allclose(np.stack(walk.estimated)[:, :3, 3].std(axis=0), np.stack(
        [se3.inverse(walk.true[0]) @ T for T in walk.true])[:, :3, 3].std(axis=0), atol=1e-6)  # fmt: skip


def test_frames_between_views_are_placed_and_one_that_is_off_takes_no_other_along(shots):
    """The last frame is tracked a hand's breadth off, beside it the one before is not."""
    walk = Walk(frames_a_shot=1).go(shots, range(0, 20, 2), growth=1.0)
    before = list(walk.estimated)
    walk.go(shots, [20], growth=1.0, slip=se3.se3_exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert walk.closures[-1].moved > 0.08
    moved = [np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(before, walk.estimated, strict=False)]
    assert max(moved[-3:]) < 0.02 and walk.error < 0.01


def test_it_goes_on_from_a_checkpoint_with_the_same_bits(shots):
    one, other = Walk().go(shots, range(0, 24, 2)), Walk()
    state = state_of(one, ("loops",))
    restore_into(other, ("loops",), state, lambda index: pytest.fail("it keeps no pictures"))
    other.true, other.estimated, other._scale = list(one.true), list(one.estimated), one._scale
    for walk in (one, other):
        walk.go(shots, range(24, 34, 2))
    np.testing.assert_array_equal(one.estimated, other.estimated)
