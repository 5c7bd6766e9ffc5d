# SPDX-License-Identifier: Apache-2.0
"""Two objects of the map that are one, and two that are two."""

import numpy as np

from ggwarp.objects.merging import MergingConfig, ObjectMerger

CONFIG = MergingConfig(together=2, apart=0.2)


def stripes(*labels: int) -> np.ndarray:
    """Return [20, 10 n] labels, a stripe each."""
    return np.repeat(np.array([labels], np.int32), 10, axis=1).repeat(20, axis=0)


def test_objects_under_one_segment_again_and_again_are_one() -> None:
    joining = ObjectMerger(CONFIG)
    known = stripes(1, 2, 3)
    assert joining.see(known, stripes(0, 0, 1), own_names=False) == []
    assert joining.see(known, stripes(5, 5, 4), own_names=False) == [(1, 2)]


def test_objects_seen_apart_stay_apart() -> None:
    joining = ObjectMerger(CONFIG)
    known = stripes(1, 2)
    joining.see(known, stripes(0, 1), own_names=False)
    assert not any(joining.see(known, stripes(0, 0), own_names=False) for _ in range(4))
    assert joining.see(known, stripes(0, 0), own_names=False) == [(1, 2)], "five to one"


def test_a_revived_id_is_the_object_it_lies_on() -> None:
    joining = ObjectMerger(CONFIG)
    known, revived = stripes(1, 2), stripes(3, 2)
    assert joining.see(known, revived, own_names=True) == []
    assert joining.see(known, revived, own_names=True) == [(1, 3)]


def test_ids_that_masks_show_side_by_side_are_two() -> None:
    """A swapped frame gives object 1 the id 2, but others show both."""
    joining = ObjectMerger(CONFIG)
    known = stripes(1, 2)
    for _ in range(4):
        assert joining.see(known, stripes(1, 2), own_names=True) == []
    assert not any(joining.see(known, stripes(2, 2), own_names=True) for _ in range(5))


def test_what_was_seen_of_a_joined_object_counts_for_the_other() -> None:
    joining = ObjectMerger(CONFIG)
    joining.see(stripes(2, 3), stripes(0, 0), own_names=False)
    joining.join(1, 2)
    assert joining.see(stripes(1, 3), stripes(0, 0), own_names=False) == [(1, 3)]


def test_nothing_is_joined_when_told_so_or_nothing_is_known() -> None:
    never = ObjectMerger(MergingConfig(together=0))
    assert not any(never.see(stripes(1, 2), stripes(0, 0), own_names=False) for _ in range(5))
    assert ObjectMerger(CONFIG).see(stripes(-1, -1), stripes(-1, -1), own_names=True) == []
