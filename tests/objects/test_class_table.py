# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ggwarp.objects import class_table
from ggwarp.objects.class_table import IGNORED, ClassTable


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


def test_a_run_has_a_bounded_number_of_classes(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(class_table, "MOST_CLASSES", 5)
    table = ClassTable()
    found = [table.encode(np.array([[10 * i, 10 * i + 1]], np.int32)).tolist() for i in range(1, 5)]
    assert found == [[[1, 2]], [[3, 4]], [[IGNORED, IGNORED]], [[IGNORED, IGNORED]]]
    assert table.encode(np.array([[0, 21]], np.int32)).tolist() == [[0, 4]] and table.count == 5
    assert len(caplog.records) == 1 and "named 4 objects" in caplog.text


def test_negative_ids_are_ignored() -> None:
    table = ClassTable()
    assert table.encode(np.array([[-4, 2]], np.int32)).tolist() == [[IGNORED, 1]]
    assert table.decode(np.array([IGNORED, 99])).tolist() == [0, 0]


def test_objects_without_an_id_get_the_lowest_free_one() -> None:
    table = ClassTable()
    table.encode(np.array([[1, 3]], np.int32))
    first, second = table.new_class(), table.new_class()
    assert table.decode(np.array([first, second])).tolist() == [0, 0]
    assert (table.assign_id(second), table.assign_id(second), table.assign_id(first)) == (2, 2, 4)
    # An id that turns out to be the masks' is theirs: what had it is named anew.
    assert table.decode(table.encode(np.array([[2, 4]], np.int32))).tolist() == [[2, 4]]
    assert table.decode(np.array([first, second])).tolist() == [6, 5]
    assert table.sources() == {}
    assert table.assign_id(0) == 0


def test_merged_classes_go_by_one_id() -> None:
    table = ClassTable()
    a, b, c = table.encode(np.array([5, 8, 9], np.int32)).tolist()
    table.merge(a, b)
    table.merge(b, c)
    assert table.decode(np.array([a, b, c])).tolist() == [5, 5, 5]
    assert table.encode(np.array([[9, 8, 0, -1]], np.int32)).tolist() == [[a, a, 0, IGNORED]]
    assert table.merged(np.array([c, 0, IGNORED], np.int32)).tolist() == [a, 0, IGNORED]
    assert table.sources() == {5: (5, 8, 9)}
    assert table.ids.tolist() == [0, 5, 5, 5]


def test_a_merged_object_keeps_the_id_that_one_of_them_had() -> None:
    table = ClassTable()
    without, with_id = table.new_class(), table.new_class()
    table.assign_id(with_id)
    table.merge(without, with_id)
    assert table.decode(np.array([without, with_id])).tolist() == [1, 1]


def test_no_object_is_not_merged() -> None:
    table = ClassTable()
    table.encode(np.array([7], np.int32))
    with pytest.raises(ValueError, match="no object"):
        table.merge(0, 1)


@given(st.lists(st.lists(st.integers(0, 100_000), min_size=1, max_size=30), max_size=5))
def test_no_id_is_lost_or_merged(masks: list[list[int]]) -> None:
    table = ClassTable()
    for mask in masks:
        array = np.array([mask], np.int32)
        assert (table.decode(table.encode(array)) == array).all()
    assert table.count == len({0}.union(*masks))


def test_objects_of_an_earlier_map_keep_their_ids() -> None:
    table = ClassTable()
    table.adopt([2, 7])
    assert table.earlier == 3 and table.decode(np.array([1, 2])).tolist() == [2, 7]
    classes = table.encode(np.array([[7, 1, 9]], np.int32))
    assert classes.tolist() == [[4, 3, 5]] and table.decode(classes).tolist() == [[3, 1, 9]]
    assert table.decode(np.array([1, 2])).tolist() == [2, 7]


def test_a_mask_s_id_may_be_an_earlier_map_s_object() -> None:
    table = ClassTable()
    table.adopt([2, 7])
    table.recognise(9, 2)
    assert table.knows(9) and not table.knows(7)
    assert table.encode(np.array([[9, 7]], np.int32)).tolist() == [[2, 3]]
    assert table.sources()[7] == (9,)
    assert table.named({9: "chair", 7: "lamp"}) == {7: "chair"} | {int(table.ids[3]): "lamp"}
