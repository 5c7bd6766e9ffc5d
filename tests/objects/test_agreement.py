# SPDX-License-Identifier: Apache-2.0
"""Objects that carry another's id: for a frame, for good, and when the map itself is wrong."""

import numpy as np

from ggwarp.objects.agreement import LabelHistory, corrected

CLASSES = 4


def picture(*columns: int) -> np.ndarray:
    """Return [20, 30] labels: a stripe of ten columns for each of three labels."""
    return np.repeat(np.array([columns], np.int32), 10, axis=1).repeat(20, axis=0)


def test_masks_that_agree_are_left_alone() -> None:
    history = LabelHistory()
    assert history.overruled(picture(1, 2, -1), picture(1, 2, 3), CLASSES) == []
    assert history.counts[1, 1] == history.counts[2, 2] == 1 and history.counts.sum() == 2


def test_one_swapped_frame_is_put_right() -> None:
    history = LabelHistory()
    known = picture(1, 2, -1)
    history.overruled(known, picture(1, 2, 0), CLASSES)
    given = picture(2, 2, 0)
    wrong = history.overruled(known, given, CLASSES)
    assert wrong == [(1, 2)]
    np.testing.assert_array_equal(corrected(known, given, wrong), picture(1, 2, 0))


def test_an_object_that_a_frame_forgot_is_put_back() -> None:
    history = LabelHistory()
    known = picture(1, 2, 3)
    wrong = history.overruled(known, picture(0, 2, 3), CLASSES)
    np.testing.assert_array_equal(corrected(known, picture(0, 2, 3), wrong), known)


def test_more_frames_than_called_it_so_rename_it() -> None:
    history = LabelHistory()
    known, given = picture(1, 2, 3), picture(3, 2, 3)
    verdicts = [history.overruled(known, given, CLASSES) for _ in range(3)]
    assert verdicts == [[(1, 3)], [], []]


def test_an_established_name_stays() -> None:
    """A track slips from object 1 to object 2 for good: 2 is called 1, and 1 is called 3."""
    history, known = LabelHistory(), np.repeat(np.int32([[1], [2]]), 30, axis=0).repeat(10, axis=1)
    slipped = np.where(known == 1, 3, 1).astype(np.int32)
    for _ in range(4):
        assert history.overruled(known, known, 4) == []
    for _ in range(20):
        wrong = history.overruled(known, slipped, 4)
        assert wrong == [(1, 3), (2, 1)]
        np.testing.assert_array_equal(corrected(known, slipped, wrong), known)


def test_a_majority_must_carry_the_other_label() -> None:
    known, given = picture(1, 1, 1), picture(1, 1, 2)
    history = LabelHistory()
    assert history.overruled(known, given, CLASSES) == []
    assert history.counts[1, 1] == 1


def test_a_few_pixels_are_no_object() -> None:
    known = np.full((20, 30), -1, np.int32)
    known[3:6, 3:6] = 1
    history = LabelHistory()
    assert history.overruled(known, picture(2, 2, 2), CLASSES) == []
    assert not history.counts.any()


def test_unseen_parts_follow_the_object_they_hang_together_with() -> None:
    # Label 2 covers all of object 1 and, apart from it, some of object 2 and something not seen before.
    known = np.full((20, 40), -1, np.int32)
    known[:, :8], known[:, 21:27], known[:, 34:37] = 1, 2, 2
    known[:, 37:] = 1
    given = np.zeros((20, 40), np.int32)
    given[:, :12], given[:, 20:30], given[:, 33:] = 2, 2, 2
    out = corrected(known, given, [(1, 2)])
    assert (out[:, :12] == 1).all(), "hangs together with object 1"
    assert (out[:, 12:20] == 0).all()
    assert (out[:, 20:30] == 2).all(), "hangs together with object 2"
    assert (out[:, 33] == -1).all(), "with both"
    assert (out[:, 34:37] == 2).all() and (out[:, 37:] == 1).all()
