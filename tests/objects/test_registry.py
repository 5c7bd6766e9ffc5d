# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ggwarp.objects.registry import IGNORED, ClassTable


def test_ids_become_classes_and_come_back() -> None:
    table = ClassTable()
    mask = np.array([[0, 7, 7], [300, 0, 65536]], np.int32)

    classes = table.encode(mask)

    assert classes.tolist() == [[0, 1, 1], [2, 0, 3]]
    assert table.count == 4
    assert (table.decode(classes) == mask).all()


def test_classes_of_earlier_frames_stay() -> None:
    table = ClassTable()
    table.encode(np.array([[5]], np.int32))
    assert table.encode(np.array([[3, 5]], np.int32)).tolist() == [[2, 1]]


def test_negative_ids_are_ignored() -> None:
    table = ClassTable()
    assert table.encode(np.array([[-4, 2]], np.int32)).tolist() == [[IGNORED, 1]]
    assert table.decode(np.array([IGNORED, 99])).tolist() == [0, 0]


def test_classes_are_found_by_id_without_adding_any() -> None:
    table = ClassTable()
    table.encode(np.array([[9, 4]], np.int32))  # classes 1 and 2 are in the order of the mask's ids
    assert table.find(np.array([[9, 0, 4, 5, -3]], np.int32)).tolist() == [[2, 0, 1, IGNORED, IGNORED]]
    assert table.count == 3


@given(st.lists(st.lists(st.integers(0, 100_000), min_size=1, max_size=30), max_size=5))
def test_no_id_is_lost_or_merged(masks: list[list[int]]) -> None:
    table = ClassTable()
    for mask in masks:
        array = np.array([mask], np.int32)
        assert (table.decode(table.encode(array)) == array).all()
    assert table.count == len({0}.union(*masks))
