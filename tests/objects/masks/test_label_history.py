# SPDX-License-Identifier: Apache-2.0
"""Objects that carry another's id: for a frame, for good, and when the map itself is wrong."""

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.masks.label_history import LabelHistory, corrected
from ggwarp.objects.masks.mask_view import MapKnowledge, MaskView, PosedDepth


def view_of(image: np.ndarray, x: float = 0.0) -> PosedDepth:
    """Return the view of a wall at 2 m, 4 cm a pixel, from ``x`` metres along it."""
    height, width = image.shape
    camera = Camera(width, height, 50.0, 50.0, 0.5 * (width - 1), 0.5 * (height - 1))
    T_wc = np.eye(4)
    T_wc[0, 3] = x
    return PosedDepth(np.full(image.shape, 2.0, np.float32), T_wc, camera)


CLASSES = ClassTable()
VIEW = view_of(np.empty((20, 30)))


def wrong_labels(
    history: LabelHistory, known: np.ndarray, given: np.ndarray, view: PosedDepth, *, anew: bool = True
) -> list[tuple[int, int]]:
    return history.wrong_labels(MaskView(view, given, MapKnowledge(known, known, known)), anew=anew)


def seen(history: LabelHistory) -> dict[tuple[int, int], int]:
    """Return (object, label) -> the most views that any place of it was called so."""
    out: dict[tuple[int, int], int] = {}
    for (_, m, label), views in history._views.items():
        out[m, label] = max(views, out.get((m, label), 0))
    return out


def picture(*columns: int) -> np.ndarray:
    """Return [20, 30] labels: a stripe of ten columns for each of three labels."""
    return np.repeat(np.array([columns], np.int32), 10, axis=1).repeat(20, axis=0)


def test_masks_that_agree_are_left_alone() -> None:
    history = LabelHistory(CLASSES)
    assert wrong_labels(history, picture(1, 2, -1), picture(1, 2, 3), VIEW) == []
    assert seen(history) == {(1, 1): 1, (2, 2): 1}


def test_one_swapped_frame_is_put_right() -> None:
    history = LabelHistory(CLASSES)
    known = picture(1, 2, -1)
    wrong_labels(history, known, picture(1, 2, 0), VIEW)
    given = picture(2, 2, 0)
    wrong = wrong_labels(history, known, given, VIEW)
    assert wrong == [(1, 2)]
    np.testing.assert_array_equal(corrected(known, given, wrong), picture(1, 2, 0))


def test_an_object_that_a_frame_forgot_is_put_back() -> None:
    history = LabelHistory(CLASSES)
    known = picture(1, 2, 3)
    wrong = wrong_labels(history, known, picture(0, 2, 3), VIEW)
    np.testing.assert_array_equal(corrected(known, picture(0, 2, 3), wrong), known)


def test_more_frames_than_called_it_so_rename_it() -> None:
    history = LabelHistory(CLASSES)
    known, given = picture(1, 2, 3), picture(3, 2, 3)
    verdicts = [wrong_labels(history, known, given, VIEW) for _ in range(3)]
    assert verdicts == [[(1, 3)], [], []]


def test_an_established_name_stays() -> None:
    """A track slips from object 1 to object 2 for good: 2 is called 1, and 1 is called 3."""
    history, known = LabelHistory(CLASSES), np.repeat(np.int32([[1], [2]]), 30, axis=0).repeat(10, axis=1)
    slipped = np.where(known == 1, 3, 1).astype(np.int32)
    for _ in range(4):
        assert wrong_labels(history, known, known, view_of(known)) == []
    for _ in range(20):
        wrong = wrong_labels(history, known, slipped, view_of(known))
        assert wrong == [(1, 3), (2, 1)]
        np.testing.assert_array_equal(corrected(known, slipped, wrong), known)


def test_a_name_is_established_by_place() -> None:
    """An object begun under the id of another that often comes is not that other."""
    history, known, label = (
        LabelHistory(CLASSES),
        np.full((20, 30), 1, np.int32),
        np.full((20, 30), 2, np.int32),
    )
    for _ in range(9):
        assert wrong_labels(history, known, known, view_of(known), anew=True) == []
    elsewhere = view_of(known, 10.0)
    verdicts = [wrong_labels(history, known, label, elsewhere) for _ in range(3)]
    assert verdicts == [[(1, 2)], [], []]
    assert wrong_labels(history, known, label, view_of(known)) == [(1, 2)]


def test_places_are_recognised_from_elsewhere() -> None:
    history, known, label = (
        LabelHistory(CLASSES),
        np.full((20, 60), 1, np.int32),
        np.full((20, 60), 2, np.int32),
    )
    for _ in range(9):
        wrong_labels(history, known, known, view_of(known))
    assert wrong_labels(history, known, label, view_of(known, 0.5)) == [(1, 2)]


def test_looking_again_counts_nothing() -> None:
    history, known, label = LabelHistory(CLASSES), picture(1, 2, 3), picture(3, 2, 3)
    for _ in range(3):
        assert wrong_labels(history, known, label, VIEW, anew=False) == [(1, 3)]
    assert not history._views


def test_merged_objects_share_what_was_seen_of_them() -> None:
    history, known = LabelHistory(CLASSES), picture(1, 2, 3)
    for given in (known, known, picture(2, 1, 3)):
        wrong_labels(history, known, given, VIEW)
    before = history._views.total()
    history.merge(1, 2)
    assert set(seen(history)) == {(1, 1), (3, 3)} and history._views.total() == before
    assert wrong_labels(history, picture(1, 1, 3), picture(3, 3, 3), VIEW) == [(1, 3)]


def test_nothing_known_nothing_wrong() -> None:
    history, unknown = LabelHistory(CLASSES), picture(-1, -1, -1)
    assert wrong_labels(history, unknown, picture(1, 2, 3), VIEW) == []
    assert wrong_labels(history, picture(1, 2, 3), unknown, VIEW) == []
    blind = PosedDepth(VIEW.depth * 0.0, VIEW.T_wc, VIEW.camera)
    assert wrong_labels(history, picture(1, 2, 3), picture(2, 1, 3), blind) == []
    assert not history._views


def test_kept_labels_come_back_merged() -> None:
    classes = ClassTable()
    one, other = classes.encode(np.array([5, 70_000], np.int32)).tolist()
    history, labels = LabelHistory(classes), picture(-1, one, other)
    assert history.kept(3, (2, 3)) is None
    history.keep(3, labels)
    np.testing.assert_array_equal(history.kept(3, labels.shape), labels)
    classes.merge(one, other)
    np.testing.assert_array_equal(history.kept(3, labels.shape), picture(-1, one, one))


def test_a_majority_must_carry_the_other_label() -> None:
    known, given = picture(1, 1, 1), picture(1, 1, 2)
    history = LabelHistory(CLASSES)
    assert wrong_labels(history, known, given, VIEW) == []
    assert seen(history)[1, 1] == 1


def test_a_few_pixels_are_no_object() -> None:
    known = np.full((20, 30), -1, np.int32)
    known[3:6, 3:6] = 1
    history = LabelHistory(CLASSES)
    assert wrong_labels(history, known, picture(2, 2, 2), VIEW) == []
    assert 2 in {label for _, label in seen(history)}, "but it is remembered"


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
