# SPDX-License-Identifier: Apache-2.0
import numpy as np

from ggwarp.objects.labels import contingency, filled, ranked, solid


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


def test_values_are_ranked_as_numpy_does(rng: np.random.Generator) -> None:
    for shape in ((7, 5), (0,), (3, 0)):
        values = rng.integers(-3, 4, shape) * 10**12
        distinct, ranks = ranked(values)
        assert np.array_equal(distinct, np.unique(values)) and np.array_equal(distinct[ranks], values)
