# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ggwarp.objects.labels import as_runs, contingency, filled, from_runs, solid


def test_pairs_of_known_labels_are_counted() -> None:
    rows = np.array([[0, 1, -1], [2, 2, 1]], np.int32)
    columns = np.array([[2, 1, 0], [0, -1, 1]], np.int32)
    assert contingency(rows, columns, 3).tolist() == [[0, 0, 1], [0, 2, 0], [1, 0, 0]]


def test_unknown_pixels_take_the_nearest_label() -> None:
    labels = np.full((9, 12), -1, np.int32)
    labels[:, 0], labels[:, 11] = 4, 7
    out = filled(labels)
    assert (out[:, :6] == 4).all() and (out[:, 6:] == 7).all()
    assert (filled(np.full((3, 3), -1, np.int32)) == -1).all()
    known = np.arange(6, dtype=np.int32).reshape(2, 3)
    assert (filled(known) == known).all()


def test_dots_and_strips_are_not_solid() -> None:
    labels = np.zeros((60, 90), np.int32)
    labels[:, 40:] = 1
    labels[20:40, 10:30] = 2
    labels[:, 60] = labels[5, 5] = labels[50:53, 70:73] = 3
    out = solid(labels)
    assert out[20:40, 10:30].all() and out[:, 44:56].all() and out[-1, 0] and out[0, -1]
    assert not out[labels == 3].any()
    assert out.mean() > 0.95
    assert solid(np.full((6, 9), 4, np.int32)).all()
    assert not solid(np.arange(54, dtype=np.int32).reshape(6, 9)).any()


@given(st.integers(1, 9), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_runs_are_the_labels_again(height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.choice(np.array([-1, 0, 7, 65534], np.int32), (height, width))
    runs = as_runs(labels)
    assert runs.dtype == np.uint16 and (runs[1] <= width).all(), "a run ends with its row"
    np.testing.assert_array_equal(from_runs(runs, labels.shape), labels)
    table = np.array([5, -1, 3], np.int32)
    small = rng.integers(-1, 2, (height, width)).astype(np.int32)
    np.testing.assert_array_equal(
        from_runs(as_runs(small), small.shape, lambda run: table[run]), table[small]
    )


@pytest.mark.parametrize("shape", [(3, 5), (4, 4), (2, 12)])
def test_runs_of_another_picture_are_refused(shape: tuple[int, int]) -> None:
    runs = as_runs(np.zeros((4, 5), np.int32))
    with pytest.raises(ValueError, match=f"{shape[1]}x{shape[0]}"):
        from_runs(runs, shape)
    with pytest.raises(ValueError, match="not two rows"):
        from_runs(runs[:1], (4, 5))
