# SPDX-License-Identifier: Apache-2.0
"""What moves is found, and only that; it is not baked into the map, nor does the camera follow it."""

from dataclasses import replace

import numpy as np
import pytest

from ggwarp.datasets.built_in.apartment import SyntheticApartment
from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.evaluation.trajectory import absolute_error
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig
from ggwarp.pipeline.moving_pixels import FreeSpace, GonePixels, MovingPixels, without_pixels
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.types import Frame

OFFICE = SyntheticOffice(scale=0.15)


def _walked_through(kinect: bool, scale: float = 0.25) -> tuple[list[Frame], int, dict[int, np.ndarray]]:
    """Keyframes of the apartment while someone crosses the view, that person's id, and the masks found."""
    apartment = SyntheticApartment(scale=scale, person=True, kinect=kinect)
    frames = [apartment[i] for i in range(0, 64, 4)]
    moving, masks = MovingPixels(apartment.camera), {}
    for number, frame in enumerate(frames):
        masks |= moving.add(number, frame.depth, frame.T_wc)
    return frames, len(apartment.class_names), masks


@pytest.mark.parametrize(("kinect", "scale"), [(False, 0.25), (True, 0.25), (False, 1.0)])
def test_who_walks_through_is_found(kinect, scale):
    frames, person, masks = _walked_through(kinect, scale)
    found = hidden = wrong = measured = 0
    for number, frame in enumerate(frames):
        there = frame.depth > 0
        mask = masks.get(number, np.zeros_like(there))
        theirs = (frame.true_mask == person) & there
        found += np.count_nonzero(mask & theirs)
        hidden += np.count_nonzero(theirs & ~mask)
        wrong += np.count_nonzero(mask & ~theirs & there)
        measured += np.count_nonzero(there)
    assert found > 0.85 * (found + hidden) > 0.05 * measured
    assert wrong < 0.03 * measured, "a rim around them"


@pytest.mark.parametrize("kinect", [False, True])
def test_nothing_moves_where_nothing_moves(kinect):
    apartment = SyntheticApartment(scale=0.2, kinect=kinect)
    for first in (0, 640, 1500):
        moving, masks = MovingPixels(apartment.camera), {}
        frames = [apartment[i] for i in range(first, first + 60, 8)]
        for number, frame in enumerate(frames):
            masks |= moving.add(number, frame.depth, frame.T_wc)
        assert sum(np.count_nonzero(m) for m in masks.values()) < 0.004 * sum(f.depth.size for f in frames)


def test_what_two_views_see_through_is_gone_and_what_hides_it_is_not():
    older = OFFICE[0]
    box = (slice(20, 60), slice(60, 110))
    before = older.depth.copy()
    before[box] *= 0.6  # something stood there
    gone, again = (GonePixels(OFFICE.camera) for _ in range(2))
    for known in (gone, again):
        known.begin(7, before, older.T_wc)
    assert gone.add(OFFICE[1].depth, OFFICE[1].T_wc) == {}, "one vote proves nothing"
    again.restore(gone.state(), lambda index: older)
    for known in (gone, again):
        [(number, pixels)] = known.add(OFFICE[2].depth, OFFICE[2].T_wc).items()
        assert number == 7 and pixels[box].mean() > 0.9
        pixels[box] = False
        assert pixels.mean() < 0.03, "a rim around it"
    assert gone.add(OFFICE[3].depth, OFFICE[3].T_wc).keys() <= {7}
    hidden = GonePixels(OFFICE.camera)
    hidden.begin(0, older.depth, older.T_wc)
    for index in (1, 2, 3):
        nearer = OFFICE[index].depth.copy()
        nearer[box] *= 0.6  # something stands there now
        assert hidden.add(nearer, OFFICE[index].T_wc) == {}


def test_one_vote_proves_nothing_two_do_and_what_stands_is_furniture():
    frames = [OFFICE[i] for i in range(6)]
    box = (slice(20, 60), slice(60, 110))

    def with_box(frame: Frame) -> np.ndarray:
        depth = frame.depth.copy()
        depth[box] = 0.8
        return depth

    moving = MovingPixels(OFFICE.camera)
    assert not moving.add(0, with_box(frames[0]), frames[0].T_wc)
    assert not moving.add(1, frames[1].depth, frames[1].T_wc)
    masks = moving.add(2, frames[2].depth, frames[2].T_wc)
    assert list(masks) == [0]
    assert masks[0][box].mean() > 0.95 and masks[0].sum() < 1.2 * masks[0][box].size
    late = MovingPixels(OFFICE.camera)
    for number, frame in enumerate(frames[:2]):
        assert not late.add(number, frame.depth, frame.T_wc)
    assert list(late.add(2, with_box(frames[2]), frames[2].T_wc)) == [2], "seen through by both before it"
    stays = MovingPixels(OFFICE.camera)
    T_wc = frames[0].T_wc
    depths = [frames[0].depth] * 2 + [with_box(frames[0])] * 4
    found = [stays.add(number, depth, T_wc) for number, depth in enumerate(depths)]
    assert 2 in found[2] and 5 not in found[5], "more found it in place than saw through it"


def test_no_depth_is_no_evidence():
    moving = MovingPixels(OFFICE.camera)
    bad = np.full_like(OFFICE[0].depth, np.nan)
    for number, depth in enumerate([OFFICE[0].depth * 0.5, bad, bad * 0, np.full_like(bad, np.inf)]):
        assert not moving.add(number, depth, OFFICE[0].T_wc)


def test_pixels_are_left_out_by_their_depth():
    where = np.zeros(OFFICE[0].depth.shape, bool)
    assert without_pixels(OFFICE[0], where).depth.all()
    where[3, 4:9] = True
    held = without_pixels(OFFICE[0], where)
    assert not held.depth[where].any() and np.array_equal(held.depth[~where], OFFICE[0].depth[~where])
    assert np.array_equal(held.rgb, OFFICE[0].rgb)


def _psnr(mapper: Mapper, frame: Frame) -> float:
    error = mapper.render(frame.T_wc).rgb - frame.rgb / 255.0
    return float(-10.0 * np.log10(np.mean(error**2)))


def test_a_person_is_not_baked_into_the_map():
    apartment, busy = (SyntheticApartment(scale=0.15, person=p) for p in (False, True))
    maps = {}
    for name, dataset in (("empty", apartment), ("busy", busy)):
        mapper = build_mapper(MapperConfig(), dataset.camera, device="cpu", use_identity=False)
        for i in range(0, 72, 4):
            assert mapper.insert(dataset[i], dataset[i].T_wc)
            for _ in range(12):
                mapper.iterate()
        mapper.synchronise()
        maps[name] = mapper
    assert maps["busy"].left_out["pixels_left_out"] > 0.05 * maps["busy"].left_out["keyframe_pixels"]
    assert maps["empty"].left_out["pixels_left_out"] < 0.01 * maps["empty"].left_out["keyframe_pixels"]
    # Baked into it, they cost 9 dB here.
    for i in (20, 28):
        assert _psnr(maps["busy"], apartment[i]) > _psnr(maps["empty"], apartment[i]) - 2.5


def test_votes_go_on_after_a_restart():
    frames = [OFFICE[i] for i in range(4)]
    depths = [f.depth.copy() for f in frames]
    depths[1][20:60, 60:110] = 0.8
    moving, again = MovingPixels(OFFICE.camera), MovingPixels(OFFICE.camera)
    for number in range(3):
        moving.add(number, depths[number], frames[number].T_wc)
    again.restore(moving.state(), lambda _: frames[0])
    ours, theirs = (m.add(3, depths[3], frames[3].T_wc) for m in (moving, again))
    assert list(ours) == list(theirs) == [1] and np.array_equal(ours[1], theirs[1])


def test_votes_follow_a_correction():
    frames = [OFFICE[i] for i in range(3)]
    moved = np.eye(4)
    moved[:3, 3] = 0.4, -0.3, 0.2
    moving = MovingPixels(OFFICE.camera)
    for number in range(2):
        moving.add(number, frames[number].depth, frames[number].T_wc)
    moving.move(lambda _: moved)
    assert not moving.add(2, frames[2].depth, moved @ frames[2].T_wc)


def test_whatever_a_frame_of_any_age_saw_through_moves():
    frames = [OFFICE[i] for i in range(40)]
    box = (slice(20, 60), slice(60, 110))
    for earlier in (1, 3, 20, 39):
        free = FreeSpace(OFFICE.camera)
        for frame in frames[:earlier]:
            free.add(frame.depth, frame.T_wc)
        depth = frames[earlier].depth.copy()
        depth[box] = 0.8
        found = free.seen_through(depth, frames[earlier].T_wc)
        assert found[box].mean() > 0.9 and found.sum() < 1.2 * found[box].size
        assert not free.seen_through(frames[earlier].depth, frames[earlier].T_wc).any()


def test_frames_testify_at_ages_that_double_and_what_stands_for_longer_is_furniture():
    frame, depth = OFFICE[0], OFFICE[0].depth.copy()
    box = (slice(20, 60), slice(60, 110))
    depth[box] = 0.8
    free = FreeSpace(OFFICE.camera)
    for _ in range(4):
        free.add(frame.depth, frame.T_wc)
    moved = 0
    for _ in range(600):
        free.add(depth, frame.T_wc)
        moved += free.seen_through(depth, frame.T_wc).any()
        assert len(free.state()["_witnesses"]) <= 8
    assert 128 <= moved <= 512


def test_free_space_is_kept_over_a_restart_and_follows_a_correction():
    frames = [OFFICE[i] for i in range(4)]
    depth = frames[3].depth.copy()
    depth[20:60, 60:110] = 0.8
    motion = np.eye(4)
    motion[:3, 3] = 0.4, -0.3, 0.2
    free, again = FreeSpace(OFFICE.camera), FreeSpace(OFFICE.camera)
    for frame in frames[:3]:
        free.add(frame.depth, frame.T_wc)
    again.restore(free.state(), lambda _: frames[0])
    found = free.seen_through(depth, frames[3].T_wc)
    assert found.any() and np.array_equal(again.seen_through(depth, frames[3].T_wc), found)
    again.move(motion)
    assert np.array_equal(again.seen_through(depth, motion @ frames[3].T_wc), found)


def test_views_that_are_kept_on_the_device_are_the_ones_that_were_given():
    """Each frame takes the place of one that no longer testifies; a fresh object uploads them all."""
    free = FreeSpace(OFFICE.camera)
    for i in range(30):
        frame, depth = OFFICE[i], OFFICE[i].depth.copy()
        depth[20:60, 60:110] = 0.8
        fresh = FreeSpace(OFFICE.camera)
        fresh.restore(free.state(), lambda _: OFFICE[0])
        found = free.seen_through(depth, frame.T_wc)
        assert np.array_equal(fresh.seen_through(depth, frame.T_wc), found) and found.any() == (i > 1)
        # Some frames testify as they were looked at, some without what moves; some are lost.
        if i % 5:
            free.add(depth if i % 3 == 0 else frame.depth, frame.T_wc)


def test_nothing_known_is_no_free_space():
    free = FreeSpace(OFFICE.camera)
    assert not free.seen_through(OFFICE[0].depth, OFFICE[0].T_wc).any()
    for bad in (np.nan, 0.0, np.inf):
        free.add(np.full_like(OFFICE[0].depth, bad), OFFICE[0].T_wc)
    assert not free.seen_through(0.5 * OFFICE[0].depth, OFFICE[0].T_wc).any()


def test_readings_are_left_out_at_the_sensors_own_resolution_too():
    frame, where = OFFICE[0], np.zeros(OFFICE[0].depth.shape, bool)
    where[10:20, 30:50] = True
    sensor = np.repeat(np.repeat(frame.depth, 2, axis=0), 2, axis=1)
    still = without_pixels(replace(frame, sensor_depth=sensor), where)
    assert np.array_equal(still.sensor_depth == 0.0, np.repeat(np.repeat(where, 2, axis=0), 2, axis=1))


def test_the_camera_does_not_follow_who_walks_by():
    errors = []
    for person in (False, True):
        apartment = SyntheticApartment(scale=0.25, person=person)
        slam = Slam(SlamConfig(loops=False), apartment.camera, apartment.camera)
        frames = [apartment[i] for i in range(50)]
        estimated = [slam.track_frame(frame).result.T_wc for frame in frames]
        errors.append(absolute_error(np.stack(estimated), np.stack([f.T_wc for f in frames])).rmse)
    assert errors[1] < 3.0 * errors[0]
