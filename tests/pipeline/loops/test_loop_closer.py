# SPDX-License-Identifier: Apache-2.0
"""Places seen again in the built-in office, by a tracker whose poses are made up."""

import dataclasses
import itertools
import threading

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.pipeline.loops import place_store
from ggwarp.pipeline.loops.features import FeatureExtractor
from ggwarp.pipeline.loops.loop_closer import LoopCloser
from ggwarp.pipeline.loops.places import Place
from ggwarp.pipeline.loops.surface_registration import Surface
from ggwarp.pipeline.tracking.preprocess import ObservationConfig, observe
from ggwarp.pipeline.tracking.relocalisation import SmallViews
from ggwarp.types import FramePoints, TrackResult, Verdict

pytest.importorskip("gtsam", reason="no wheels for this Python")

OFFICE = SyntheticOffice(scale=0.2)
WALK = [*range(0, 45, 5), *range(45, -1, -5)]
"""There and back again."""
DRIFT = se3.se3_exp([0.01, 0.0, 0.008, 0.0, 0.006, 0.0])
"""How much tracking errs from one frame to the next."""


@pytest.fixture(scope="module")
def frames():
    return {i: OFFICE[i] for i in set(WALK)}


def made(folder=None):
    noise = ObservationConfig().depth_noise
    return LoopCloser(OFFICE.camera, OFFICE.camera, noise, least_move=0.025, device="cpu", folder=folder)


def points_of(frame):
    seen = observe(frame.depth, OFFICE.camera, ObservationConfig(points=2000), device="cpu")
    arrays = (x.numpy() for x in (seen.cloud.points, seen.quats, seen.spreads))
    return FramePoints(*arrays, noise=seen.noise, distances2=seen.noise)


def tracked(T_wc, frame, verdict=Verdict.CONVERGED, information=None):
    return TrackResult(T_wc, verdict, points=points_of(frame), information=information)


def walk(frames, drift, closer=None, order=WALK):
    """Return the closures, and true and estimated poses at the end; the first pose is the true one."""
    closer = closer or made()
    closures, true, estimated = [], [], []
    T = frames[order[0]].T_wc
    for step, i in enumerate(order):
        if step:
            T = T @ se3.inverse(frames[order[step - 1]].T_wc) @ frames[i].T_wc @ drift
        frame = dataclasses.replace(frames[i], index=step, T_wc=None)
        found = [closer.observe(frame, tracked(T, frame))]
        estimated.append(T)
        true.append(frames[i].T_wc)
        if step == len(order) - 1:
            found.append(closer.finish())
        for closure in found:
            if closure is not None:
                closures.append(closure)
                motions = closure.correction.at(range(step + 1))
                estimated = [M @ E for M, E in zip(motions, estimated, strict=True)]
                T = estimated[-1]
    return closures, np.stack(true), np.stack(estimated)


@pytest.fixture(scope="module")
def drifted(frames):
    return walk(frames, DRIFT)


def errors(true, estimated):
    return np.linalg.norm(true[:, :3, 3] - estimated[:, :3, 3], axis=1)


def test_a_place_seen_again_takes_the_drift_away(drifted):
    closures, true, estimated = drifted
    without = true[0]
    for a, b in itertools.pairwise(true):
        without = without @ se3.inverse(a) @ b @ DRIFT
    assert closures and all(c.seen_before < c.frame and c.moved > 0.025 for c in closures)
    drift = float(np.linalg.norm(without[:3, 3] - true[-1, :3, 3]))
    assert drift > 0.15 and errors(true, estimated)[-1] < 0.25 * drift
    np.testing.assert_allclose(estimated[0], true[0], atol=1e-5)  # the world stays where it is


RANK_FIVE = np.random.default_rng(12).integers(-1, 2, (6, 5)).astype(np.float64)
"""Its square has no inverse, though rounding gives it six positive eigenvalues."""


@pytest.mark.parametrize(
    "information",
    [np.zeros((6, 6)), np.diag([0, 0, 1e7, 1e7, 1e7, 0]), RANK_FIVE @ RANK_FIVE.T],
    ids=["nothing", "a wall", "rank five"],
)
def test_tracking_before_a_wall_says_nothing_along_it(frames, information):
    closer = made()
    for step, i in enumerate(WALK[:6]):
        frame = dataclasses.replace(frames[i], index=step, T_wc=None)
        result = tracked(frames[i].T_wc, frame, information=information)
        assert closer.observe(frame, result) is None
    assert closer.finish() is None


def test_without_drift_nothing_is_moved(frames):
    closures, _, _ = walk(frames, np.eye(4))
    assert not closures


def test_a_second_run_gives_the_same_bits(frames, drifted):
    """Frames that are lost or have no points in between are no places."""
    closer, frame = made(), frames[0]
    assert closer.observe(frame, tracked(frame.T_wc, frame, Verdict.LOST)) is None
    assert closer.observe(frame, TrackResult(frame.T_wc, Verdict.CONVERGED)) is None
    one, other = drifted, walk(frames, DRIFT, closer)
    assert len(one[0]) == len(other[0]) > 0
    np.testing.assert_array_equal(one[2], other[2])


def test_one_picture_out_of_place_moves_nothing(frames):
    """A single view that looks like an earlier one from far away: nobody else says so."""
    closer = made()
    outward = WALK[: len(WALK) // 2]
    closures, _, estimated = walk(frames, np.eye(4), closer, outward)
    assert not closures
    strange = dataclasses.replace(frames[5], index=len(outward), T_wc=None)
    T = estimated[-1] @ se3.se3_exp([2.0, 0, 0, 0, 1.0, 0])
    assert closer.observe(strange, tracked(T, strange)) is None
    assert closer.finish() is None and len(closer._places) == len(outward) + 1


@pytest.mark.parametrize(
    "information", [np.zeros((6, 6)), np.diag([0, 1.0, 1, 1, 1, 1]), np.full((6, 6), np.nan)]
)
def test_a_frame_that_can_slide_is_a_place_all_the_same(frames, information):
    closer = made()
    for step, i in enumerate(WALK[:3]):
        result = tracked(frames[i].T_wc, frames[i], information=information)
        assert closer.observe(dataclasses.replace(frames[i], index=step, T_wc=None), result) is None
    assert closer.finish() is None and len(closer._places) == 3


def test_views_of_an_earlier_map_take_the_drift_away_and_stay(frames):
    """The camera goes away from where it began, to where another run has been."""
    extractor, pictures = FeatureExtractor(OFFICE.camera, OFFICE.camera), SmallViews(OFFICE.camera)

    def place(i):
        frame = frames[i]
        shown = extractor.extract(frame), pictures.view(frame), Surface.of(points_of(frame))
        return Place(-1 - i, frame.T_wc, 2.0, *shown)

    seen = range(45, -1, -5)
    places = [place(i) for i in seen]
    outward = WALK[: len(WALK) // 2]
    alone, true, estimated = walk(frames, DRIFT, order=outward)
    assert not alone, "no place is seen twice"
    drift = errors(true, estimated)[-1]
    closer = made()
    closer.adopt(places)
    closures, true, estimated = walk(frames, DRIFT, closer, outward)
    assert closures and all(c.seen_before < 0 <= c.frame for c in closures)
    assert drift > 0.07 and errors(true, estimated)[-1] < 0.4 * drift
    for closure in closures:
        still = closure.correction.at([place.index for place in places])
        np.testing.assert_array_equal(still, np.tile(np.eye(4), (len(places), 1, 1)))
    for place, i in zip(places, seen, strict=True):
        np.testing.assert_allclose(place.T_wc, frames[i].T_wc, atol=1e-9)


def test_loops_are_closed_to_places_in_a_file(frames, tmp_path, monkeypatch):
    """The same loops to the bit, also after a restart."""
    expected, _, poses = walk(frames, DRIFT)
    monkeypatch.setattr(place_store, "_IN_MEMORY", 0)
    closer = made(lambda: tmp_path)
    found, _, paged_poses = walk(frames, DRIFT, closer)
    store = closer._places._store
    assert store.held < store.stored / 20 and list(tmp_path.iterdir()) == []
    assert len(found) == len(expected) > 0
    for one, other in zip(expected, found, strict=True):
        assert one.correction.indices == other.correction.indices and one.seen_before == other.seen_before
        np.testing.assert_array_equal(one.correction.motions, other.correction.motions)
    np.testing.assert_array_equal(poses, paged_poses)
    again = made(lambda: tmp_path)
    again.restore(closer.state(), lambda index: frames[index])
    for number in range(len(closer._places)):
        for shown in ("features", "view", "surface"):
            one, other = (vars(getattr(c._places, shown)(number)) for c in (closer, again))
            for name, values in one.items():
                np.testing.assert_array_equal(values, other[name], err_msg=name)


def test_a_place_that_has_begun_is_part_of_a_state(frames, monkeypatch):
    """Whether the thread was done or not: after any frame another object goes on with the same bits."""
    expected, _, poses = walk(frames, DRIFT)
    begun = 0

    class Restarted:
        """A loop closer that is saved and restored after every frame, its thread left behind."""

        def __init__(self):
            self.closer, self.taken = made(), {}

        def observe(self, frame, result):
            nonlocal begun
            self.taken[frame.index] = frame
            closure = self.closer.observe(frame, result)
            again = made()
            again.restore(self.closer.state(), self.taken.__getitem__)
            begun += again._begun is not None
            self.closer = again
            return closure

        def finish(self):
            return self.closer.finish()

    found, _, restarted = walk(frames, DRIFT, Restarted())
    assert begun > len(WALK) // 2
    assert [c.correction.indices for c in found] == [c.correction.indices for c in expected]
    np.testing.assert_array_equal(poses, restarted)


def test_what_fails_in_the_thread_is_said_with_the_next_frame(frames, monkeypatch):
    def extract(self, frame):
        raise RuntimeError("no features today")

    monkeypatch.setattr(FeatureExtractor, "extract", extract)
    closer, frame = made(), frames[0]
    assert closer.observe(frame, tracked(frame.T_wc, frame)) is None
    with pytest.raises(RuntimeError, match="no features today"):
        closer.observe(frames[5], tracked(frames[5].T_wc, frames[5]))


def test_no_thread_outlives_the_place_it_looks_for(frames):
    closer, frame = made(), frames[0]
    closer.observe(frame, tracked(frame.T_wc, frame))
    for thread in threading.enumerate():
        if thread.name.startswith("ggwarp-loops"):
            thread.join(timeout=30.0)
            assert not thread.is_alive()
    closer.finish()
