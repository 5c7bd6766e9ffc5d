# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.evaluation.evaluate import evaluate
from ggwarp.types import Frame, Rendered

SHAPE = (20, 24)


def _frame(index: int, **changes) -> Frame:
    mask = np.zeros(SHAPE, np.int32)
    mask[:10] = 3
    values = {
        "rgb": np.full((*SHAPE, 3), 102, np.uint8),
        "depth": np.full(SHAPE, 2.0, np.float32),
        "mask": mask,
    } | changes
    return Frame(index, 0.1 * index, **values)


def _view(T_wc) -> Rendered:
    """Further along x the colour is further off."""
    colour = np.float32(0.4 + T_wc[0, 3])
    objects = np.zeros(SHAPE, np.int32)
    objects[:10] = 3 if T_wc[0, 3] < 0.15 else 4
    depth = np.full(SHAPE, 2.01, np.float32)
    return Rendered(np.full((*SHAPE, 3), colour), depth, depth, np.ones(SHAPE, np.float32), None, objects)


def _pose(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_both_protocols():
    poses = {0: _pose(0.1), 1: _pose(0.1), 2: _pose(0.2)}
    seen = []
    result = evaluate(
        [_frame(i) for i in range(4)],
        poses,
        _view,
        mapped=[0, 1],
        on_view=lambda f, v, s: seen.append((f.index, s.held_out)),
    )
    assert seen == [(0, False), (1, False), (2, True)]  # frame 3 has no pose
    assert [s.psnr for s in result.per_frame] == pytest.approx([20.0, 20.0, 13.979], abs=1e-3)
    assert result.all_frames.frames == 3 and result.held_out.frames == 1
    assert result.all_frames.psnr == pytest.approx((20 + 20 + 13.979) / 3, abs=1e-3)
    assert result.held_out.psnr == pytest.approx(13.979, abs=1e-3)
    assert result.all_frames.depth_l1_cm == pytest.approx(1.0, abs=1e-3)
    assert result.all_frames.miou == pytest.approx(2 / 3) and result.held_out.miou == 0.0
    assert result.all_frames.lpips is None


def test_objects_are_compared_with_the_truth_where_it_is_known():
    """The mapper's masks say 3 above and were spoilt; a frame without truth is not mixed in."""
    truth = np.zeros(SHAPE, np.int32)
    truth[:10] = 3
    spoilt = np.full(SHAPE, 4, np.int32)
    frames = [_frame(0, mask=spoilt, true_mask=truth), _frame(1, mask=spoilt)]
    poses = {0: _pose(0.1), 1: _pose(0.1)}
    result = evaluate(frames, poses, _view, mapped=[0])
    assert result.miou_against == "truth"
    assert result.all_frames.miou == result.all_frames.pixel_accuracy == 1.0
    assert [(row.id, row.pixels) for row in result.objects] == [(3, 240)]
    assert result.held_out.miou is None  # frame 1 has no truth
    given = evaluate([frames[1]], poses, _view, mapped=[])
    assert given.miou_against == "given" and given.all_frames.miou == 0.0


def test_objects_are_not_held_out_where_the_mask_was_used():
    frames, poses = [_frame(i) for i in range(3)], {0: _pose(0.1), 1: _pose(0.2), 2: _pose(0.1)}
    result = evaluate(frames, poses, _view, mapped=[0], watched=[1])
    assert result.held_out.frames == 2 and result.held_out.miou == 1.0
    assert evaluate(frames, poses, _view, mapped=[0], watched=[1, 2]).held_out.miou is None


def test_a_true_mask_alone_is_enough():
    truth = _frame(0).mask
    result = evaluate([_frame(0, mask=None, true_mask=truth)], {0: _pose(0.1)}, _view, mapped=[])
    assert result.all_frames.miou == 1.0 and result.miou_against == "truth"


def test_what_is_not_there_is_not_measured():
    result = evaluate([_frame(0, depth=None, mask=None)], {0: _pose(0.1)}, _view, mapped=[0])
    scores = result.all_frames
    assert scores.psnr == pytest.approx(20.0, abs=1e-3)
    assert scores.depth_l1_cm is None and scores.miou is None and scores.pixel_accuracy is None
    assert result.held_out.frames == 0 and result.held_out.psnr is None
    assert result.miou_against is None and result.objects == []


def test_a_frame_without_a_single_reading_is_passed_over_in_the_means():
    blind = _frame(1, depth=np.zeros(SHAPE, np.float32))
    result = evaluate([_frame(0), blind], {0: _pose(0.1), 1: _pose(0.1)}, _view, mapped=[])
    assert result.per_frame[1].psnr is None
    assert result.all_frames.psnr == pytest.approx(20.0, abs=1e-3)


def test_lpips_is_used_when_given():
    result = evaluate([_frame(0)], {0: _pose(0.1)}, _view, mapped=[], lpips=lambda a, b: 0.25)
    assert result.all_frames.lpips == 0.25 and result.held_out.lpips == 0.25


def test_surface_depth():
    """The expected depth of what there is, or nothing."""
    plane = np.array([[1.8, 0.3, 0.0]], np.float32)
    median = np.array([[2.1, 0.0, 0.0]], np.float32)
    opacity = np.array([[0.9, 0.1, 0.0]], np.float32)
    view = Rendered(np.zeros((1, 3, 3), np.float32), plane, median, opacity)
    np.testing.assert_allclose(view.surface_depth, [[2.0, 3.0, 0.0]], rtol=1e-6)
