# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.evaluation.objects import ObjectScore


def _score(*pairs: tuple[list, list]) -> ObjectScore:
    score = ObjectScore()
    for predicted, true in pairs:
        score.add(np.array(predicted, np.int32), np.array(true, np.int32))
    return score


def test_perfect_masks():
    score = _score(([[1, 2], [0, 300]], [[1, 2], [0, 300]]))
    assert score.iou() == {1: 1.0, 2: 1.0, 300: 1.0}
    assert score.mean_iou() == 1.0 and score.accuracy() == 1.0


def test_counts_are_summed_before_the_ratio():
    """One big image right and one small one wrong is not the mean of two images."""
    score = _score(([[1] * 9], [[1] * 9]), ([[0]], [[1]]))
    assert score.iou() == {1: 0.9}
    assert score.accuracy() == 0.9


def test_painting_over_the_background_costs():
    score = _score(([[1, 1, 1, 1]], [[1, 1, 0, 0]]))
    assert score.mean_iou() == 0.5 and score.accuracy() == 0.5


def test_an_object_that_is_missing_counts_zero():
    assert _score(([[1, 1, 1]], [[1, 1, 7]])).mean_iou() == pytest.approx((2 / 3 + 0) / 2)


def test_an_object_that_the_masks_do_not_know_is_no_object_of_theirs():
    score = _score(([[1, 9]], [[1, 1]]))
    assert score.iou() == {1: 0.5}


def test_unlabelled_pixels_do_not_count():
    score = _score(([[1, 5]], [[1, -1]]))
    assert score.iou() == {1: 1.0} and score.accuracy() == 1.0


def test_nothing_to_measure():
    assert _score().mean_iou() is None and _score().accuracy() is None
    background = _score(([[0]], [[0]]))
    assert background.mean_iou() is None and background.accuracy() == 1.0


def test_sum_of_two_scores_is_the_score_of_both():
    one, two = ([[1, 2]], [[1, 1]]), ([[2, 2]], [[2, 1]])
    both = _score(one) + _score(two)
    assert both.iou() == _score(one, two).iou() and both.accuracy() == _score(one, two).accuracy()
