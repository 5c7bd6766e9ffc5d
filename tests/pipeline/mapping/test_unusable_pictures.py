# SPDX-License-Identifier: Apache-2.0
"""Pictures that contradict the map are found, and not baked into it."""

from dataclasses import replace

import numpy as np

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.pipeline.mapping.passed_over import PassedOver
from ggwarp.pipeline.mapping.unusable_pictures import clipped_share, different_share, unusable
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.pipeline.tracking.keyframe_policy import KeyframeConfig
from ggwarp.types import Frame, Rendered

OFFICE = SyntheticOffice(scale=0.15)


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


def test_large_pictures_are_judged_as_small_ones():
    large = SyntheticOffice(scale=0.5)[0]
    white = np.minimum(255, large.rgb.astype(int) + 190).astype(np.uint8)
    rows = np.arange(large.rgb.shape[0])[:, None, None]
    for part, out in ((0.3, False), (0.9, True)):
        picture = replace(large, rgb=np.where(rows < part * len(rows), white, large.rgb))
        assert bool(unusable(picture, _view(large))) == out


def test_a_map_that_explains_nothing_contradicts_nothing():
    frame = OFFICE[0]
    view, white = _view(frame), replace(frame, rgb=np.full_like(frame.rgb, 255))
    unknown = replace(view, opacity=np.zeros_like(frame.depth))
    elsewhere = replace(view, depth=2.0 * frame.depth)
    for rendered in (unknown, elsewhere):
        assert clipped_share(white, rendered) == 0.0 == different_share(white, rendered)


def _mapped(frames: list[Frame], keyframes: KeyframeConfig | None = None) -> tuple[Slam, list[int]]:
    """The system after ``frames``, and those that its reports call keyframes."""
    config = SlamConfig(use_identity=False, keyframes=keyframes or KeyframeConfig())
    slam = Slam(config, OFFICE.camera, OFFICE.camera)
    reports = [slam.step(frame) for frame in frames]
    return slam, [r.index for r in reports if r.keyframe]


def test_pictures_that_are_left_out_are_counted_and_the_next_takes_their_place(caplog):
    frames = [OFFICE[i] for i in range(9)]
    usual = _mapped(frames)[1]
    white = usual[2]
    frames[white] = replace(frames[white], rgb=np.full_like(frames[white].rgb, 255))
    slam, keyframes = _mapped(frames)
    assert white not in keyframes and white + 1 in keyframes and white + 1 not in usual
    assert white - 1 not in keyframes, "what was reported of it"
    assert slam.keyframe_indices == sorted([*keyframes, white - 1])
    assert slam.counts["pictures_left_out"] == 1
    assert f"frame {white} is not mapped" in caplog.text


def test_the_last_good_frame_before_bad_pictures_is_mapped():
    """It alone shows what has left the view by the time that pictures are good again."""
    rare = KeyframeConfig(overlap=0.0, mapping_interval=4)
    frames = [OFFICE[i] for i in range(12)]
    slam, usual = _mapped(frames, rare)
    assert slam.keyframe_indices == usual == [0, 4, 8]
    for i in range(7, 10):
        frames[i] = replace(frames[i], rgb=np.full_like(frames[i].rgb, 255))
    slam, reported = _mapped(frames, rare)
    assert slam.keyframe_indices == [0, 4, 6, 10] and reported == [0, 4, 10]


def test_frames_passed_over_follow_a_loop_and_are_few():
    passed = PassedOver()
    for i in range(9):
        passed.add(OFFICE[i], np.eye(4))
    motion = se3.se3_exp([0.1, 0.0, 0.0, 0.0, 0.2, 0.0])
    passed.move(PoseCorrection((0, 20), np.stack([np.eye(4), motion])))
    frame, T_wc = passed.pop()
    assert frame.index == 8 and len(passed) < 8
    np.testing.assert_allclose(T_wc, se3.interpolate(np.eye(4), motion, 0.4), atol=1e-12)
    passed.clear()
    assert not passed
