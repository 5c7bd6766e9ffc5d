# SPDX-License-Identifier: Apache-2.0
"""What contradicts the rest of a recording is found, and only that; and it is not baked into the map."""

from dataclasses import replace

import numpy as np
import pytest

from ggwarp.datasets.built_in.apartment import SyntheticApartment
from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.contradiction import (
    MovingPixels,
    clipped_share,
    different_share,
    unusable,
    without_pixels,
)
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.types import Frame, Rendered

OFFICE = SyntheticOffice(scale=0.15)


def _walked_through(kinect: bool) -> tuple[list[Frame], int, dict[int, np.ndarray]]:
    """Keyframes of the apartment while someone crosses the view, that person's id, and the masks found."""
    apartment = SyntheticApartment(scale=0.25, person=True, kinect=kinect)
    frames = [apartment[i] for i in range(0, 64, 4)]
    moving, masks = MovingPixels(apartment.camera), {}
    for number, frame in enumerate(frames):
        masks |= moving.add(number, frame.depth, frame.T_wc)
    return frames, len(apartment.class_names), masks


@pytest.mark.parametrize("kinect", [False, True])
def test_who_walks_through_is_found(kinect):
    frames, person, masks = _walked_through(kinect)
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


def _view(frame: Frame) -> Rendered:
    """What a perfect map shows."""
    opaque = np.ones_like(frame.depth)
    return Rendered(frame.rgb.astype(np.float32) / 255.0, frame.depth, frame.depth, opaque)


def test_a_clipped_picture_is_of_no_use_and_an_exposed_one_is():
    frame = OFFICE[0]
    bright = replace(frame, rgb=np.minimum(255, frame.rgb.astype(int) + 190).astype(np.uint8))
    black = replace(frame, rgb=np.zeros_like(frame.rgb))
    louder = replace(frame, rgb=np.minimum(255, frame.rgb * 1.2).astype(np.uint8))
    shares = [clipped_share(f, _view(frame)) for f in (bright, black, louder, frame)]
    assert [bool(unusable(f, _view(frame))) for f in (bright, black, louder, frame)] == [
        True,
        True,
        False,
        False,
    ]
    assert shares[3] == 0.0 and shares[2] < 0.2
    part = replace(frame, rgb=np.where(np.arange(frame.rgb.shape[1])[:, None] < 60, bright.rgb, frame.rgb))
    assert 0.2 < clipped_share(part, _view(frame)) < 0.5


def test_a_picture_of_something_else_is_of_no_use(rng: np.random.Generator):
    """A decoder's garbage, or the picture of another place; not one of another exposure or white balance."""
    frame, view = OFFICE[0], _view(OFFICE[0])
    garbage = replace(frame, rgb=rng.integers(0, 256, frame.rgb.shape).astype(np.uint8))
    elsewhere = replace(frame, rgb=255 - frame.rgb[::-1, ::-1])
    assert "has other colours" in unusable(garbage, view) and "has other colours" in unusable(elsewhere, view)
    half = replace(frame, rgb=np.where(np.arange(frame.rgb.shape[0])[:, None, None] < 50, frame.rgb, 128))
    dark = replace(frame, rgb=(0.4 * frame.rgb).astype(np.uint8))
    warm = replace(frame, rgb=(frame.rgb * [1.0, 0.8, 0.5] + [0, 10, 20]).astype(np.uint8))
    noisy = np.clip(frame.rgb + rng.normal(0, 15, frame.rgb.shape), 0, 255).astype(np.uint8)
    for usable in (frame, half, dark, warm, replace(frame, rgb=noisy)):
        assert unusable(usable, view) == ""
    assert different_share(frame, view) == 0.0 and different_share(dark, view) < 0.05


def test_pixels_are_left_out_by_their_depth():
    where = np.zeros(OFFICE[0].depth.shape, bool)
    assert without_pixels(OFFICE[0], where).depth.all()
    where[3, 4:9] = True
    held = without_pixels(OFFICE[0], where)
    assert not held.depth[where].any() and np.array_equal(held.depth[~where], OFFICE[0].depth[~where])
    assert np.array_equal(held.rgb, OFFICE[0].rgb)


def test_a_map_that_explains_nothing_contradicts_nothing():
    frame = OFFICE[0]
    view, white = _view(frame), replace(frame, rgb=np.full_like(frame.rgb, 255))
    unknown = replace(view, opacity=np.zeros_like(frame.depth))
    elsewhere = replace(view, depth=2.0 * frame.depth)
    for rendered in (unknown, elsewhere):
        assert clipped_share(white, rendered) == 0.0 == different_share(white, rendered)


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


def test_pictures_that_are_left_out_are_counted_and_the_next_takes_their_place(caplog):
    frames = [OFFICE[i] for i in range(9)]
    frames[4] = replace(frames[4], rgb=np.full_like(frames[4].rgb, 255))
    slam = Slam(SlamConfig(use_identity=False), OFFICE.camera, OFFICE.camera)
    reports = [slam.step(frame) for frame in frames]
    assert 4 not in slam.keyframe_indices and 5 in slam.keyframe_indices
    assert [r.index for r in reports if r.keyframe] == slam.keyframe_indices
    assert slam.counts["pictures_left_out"] == 1
    assert "frame 4 is not mapped" in caplog.text


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
    moving.move(np.stack([moved, moved]))
    assert not moving.add(2, frames[2].depth, moved @ frames[2].T_wc)
