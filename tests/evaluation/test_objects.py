# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.evaluation.objects import ObjectFigures, ObjectScore, interior


def _score(*pairs: tuple[list, list]) -> ObjectScore:
    """The score of pairs of a rendered and a true image."""
    score = ObjectScore()
    for rendered, true in pairs:
        score.add(np.array(rendered, np.int32), np.array(true, np.int32))
    return score


def _ious(score: ObjectScore) -> dict[int, float]:
    return {row.id: row.iou for row in score.table()}


def test_perfect_masks():
    score = _score(([[1, 2], [0, 300]], [[1, 2], [0, 300]]))
    assert _ious(score) == {1: 1.0, 2: 1.0, 300: 1.0}
    assert score.figures() == ObjectFigures(
        miou=1.0,
        miou_matched=1.0,
        pq=1.0,
        sq=1.0,
        rq=1.0,
        pixel_accuracy=1.0,
        objects_true=3,
        objects_found=3,
    )


def test_counts_are_summed_before_the_ratio():
    """One big image right and one small one wrong is not the mean of two images."""
    score = _score(([[1] * 9], [[1] * 9]), ([[0]], [[1]]))
    assert _ious(score) == {1: 0.9}
    assert score.figures().pixel_accuracy == 0.9


def test_painting_over_the_background_costs():
    figures = _score(([[1, 1, 1, 1]], [[1, 1, 0, 0]])).figures()
    assert figures.miou == 0.5 and figures.pixel_accuracy == 0.5


def test_an_object_that_is_missing_counts_zero():
    assert _score(([[1, 1, 1]], [[1, 1, 7]])).figures().miou == pytest.approx((2 / 3 + 0) / 2)


def test_an_object_that_the_masks_do_not_know_is_no_object_of_theirs():
    score = _score(([[1, 9]], [[1, 1]]))
    assert _ious(score) == {1: 0.5}
    assert (score.figures().objects_true, score.figures().objects_found) == (1, 2)


def test_unlabelled_pixels_do_not_count():
    score = _score(([[1, 5]], [[1, -1]]))
    assert _ious(score) == {1: 1.0}
    assert score.figures().pixel_accuracy == 1.0 and score.figures().objects_found == 1


def test_nothing_to_measure():
    assert _score().figures() == _score(([[3]], [[-1]])).figures() == ObjectFigures()
    assert not _score() and _score().table() == []
    background = _score(([[0]], [[0]])).figures()
    assert background == ObjectFigures(pixel_accuracy=1.0, objects_true=0, objects_found=0)


def test_sum_of_two_scores_is_the_score_of_both():
    one, two = ([[1, 2]], [[1, 1]]), ([[2, 2]], [[2, 1]])
    both = _score(one) + _score(two)
    assert both.table() == _score(one, two).table() and both.figures() == _score(one, two).figures()


def test_other_names_for_the_same_objects():
    """The ids as they are agree nowhere; matched, everything does."""
    score = _score(([[7, 7, 0, 9]], [[1, 1, 0, 2]]))
    figures = score.figures()
    assert figures.miou == 0.0 and figures.pixel_accuracy == 0.25
    assert figures.miou_matched == figures.pq == 1.0
    assert [(r.id, r.rendered_pixels, r.matched_id) for r in score.table()] == [(1, 0, 7), (2, 0, 9)]


def test_matching_is_the_best_of_all_and_one_to_one():
    """Greedily 1 takes 7 (5 pixels) and leaves nothing to 2; the best is 1-8 and 2-7."""
    true = [[1] * 9 + [2] * 4 + [3] * 2]
    rendered = [[7] * 5 + [8] * 4 + [7] * 4 + [8] * 2]
    rows = _score((rendered, true)).table()
    assert [(r.id, r.matched_id) for r in rows] == [(1, 8), (2, 7), (3, None)]
    assert [r.iou_matched for r in rows] == pytest.approx([4 / 11, 4 / 9, 0.0])
    assert _score((rendered, true)).figures().miou_matched == pytest.approx((4 / 11 + 4 / 9) / 3)


def test_matching_is_over_the_whole_sequence():
    """An object that goes by 7 twice and by 8 once is 7."""
    same, other = ([[7, 7, 7, 7]], [[1, 1, 1, 1]]), ([[8, 8]], [[1, 1]])
    (row,) = _score(same, other, same).table()
    assert row.matched_id == 7 and row.iou_matched == 0.8


def test_panoptic_quality():
    """Recognised: 1 in the first image (IoU 1) and in the second (3 of 4). Missed: 2 (1 of 3). Ghost: 9."""
    first = ([[1, 1, 2, 0, 0]], [[1, 1, 2, 2, 2]])
    second = ([[1, 1, 1, 9, 0]], [[1, 1, 1, 1, 0]])
    figures = _score(first, second).figures()
    assert figures.sq == pytest.approx((1.0 + 0.75) / 2)
    assert figures.rq == pytest.approx(2 / (2 + 0.5 * 2 + 0.5 * 1))  # TP / (TP + FP / 2 + FN / 2)
    assert figures.pq == pytest.approx(figures.sq * figures.rq)


def test_half_an_object_is_not_recognised():
    figures = _score(([[1, 1, 0, 0]], [[1, 1, 1, 1]])).figures()
    assert figures.pq == 0.0 and figures.rq == 0.0 and figures.sq is None


def test_borders_are_left_out_of_the_interior():
    """Every render is off by two pixels on one side: that is no error inside, a third one is."""
    true = np.zeros((9, 24), np.int32)
    true[:, 12:] = 4
    for shift, expected in ((2, 1.0), (3, 10 / 11)):
        rendered = np.zeros_like(true)
        rendered[:, 12 - shift :] = 4
        score = ObjectScore()
        score.add(rendered, true)
        assert score.figures().miou_interior == pytest.approx(expected)
        assert score.figures().miou == pytest.approx(12 / (12 + shift))


def test_interior():
    mask = np.zeros((7, 9), np.int32)
    mask[:, 4:] = 2**24 + 1
    mask[:, 8] = 2**24  # one apart: too fine for single precision
    expected = np.zeros((7, 9), bool)
    expected[:, :2] = True
    np.testing.assert_array_equal(interior(mask), expected)
    assert interior(mask, border=1)[:, [0, 1, 2, 5, 6]].all() and interior(mask, border=1).sum() == 35
    assert interior(np.full((1, 1), 3, np.int32)).all()


def test_a_thin_object_has_no_interior():
    true = np.zeros((9, 9), np.int32)
    true[4] = 1
    score = ObjectScore()
    score.add(true, true)
    assert score.table()[0].iou_interior is None and score.figures().miou_interior is None


def test_against_pixel_by_pixel_counting(rng):
    """Large ids, many runs, holes: the same as counting pixels one by one."""
    ids = np.array([-1, 0, 5, 70_000, 2**31 - 1])
    images = [tuple(ids[rng.integers(k, 5, (20, 30)) // 1] for k in (1, 0)) for _ in range(3)]
    score = ObjectScore()
    for rendered, true in images:
        score.add(rendered.astype(np.int32), true.astype(np.int32))
    rendered, true = (np.concatenate([i[k].ravel() for i in images]) for k in (0, 1))
    rendered, true = rendered[true >= 0], true[true >= 0]
    for row in score.table():
        both, either = (true == row.id) & (rendered == row.id), (true == row.id) | (rendered == row.id)
        assert row.iou == both.sum() / either.sum()
        assert (row.pixels, row.rendered_pixels) == ((true == row.id).sum(), (rendered == row.id).sum())
    assert [row.id for row in score.table()] == [5, 70_000, 2**31 - 1]
    assert score.figures().pixel_accuracy == np.mean(true == rendered)


@pytest.mark.parametrize("factor", [2, 3])
def test_masks_are_measured_at_their_own_resolution(factor: int) -> None:
    """Each of a mask's pixels is held against the rendered one that it falls into."""
    rendered = np.array([[1, 1, 2, 2], [1, 1, 2, 2]], np.int32)
    true = np.kron(rendered, np.ones((factor, factor), np.int32)).astype(np.int32)
    true[:, 2 * factor] = 1  # the border lies one of the mask's pixels further on
    score = ObjectScore()
    score.add(rendered, true)
    ones, twos = 2 * factor, 2 * factor - 1
    assert score.figures().miou == pytest.approx(0.5 * (ones / (ones + 1) + twos / (twos + 1)))
    small = ObjectScore()
    small.add(true, rendered)
    assert small.figures().miou is not None and small.table()[0].pixels == 4
