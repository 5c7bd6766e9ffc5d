# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest

from ggwarp.editing.selection import SelectionConfig, orphans, select
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.linear_classifier import LinearClassifier

BY_ID = SelectionConfig(adopt=False)


@pytest.fixture
def gaussians(rng) -> Gaussians:
    """A cube of object 5, two of its strays, and 0 elsewhere, also within the cube."""
    inside, around = rng.uniform(0, 1, (300, 3)), rng.uniform(-4, 4, (300, 3))
    means = np.concatenate([inside, around]).astype(np.float32)
    means[298:300] = [[9, 9, 9], [-8, 0, 0]]
    ids = np.repeat([5, 0], 300).astype(np.int32)
    ids[:20] = 0
    n = len(means)
    return Gaussians(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.zeros((n, 3), np.float32),
        np.zeros(n, np.float32),
        np.zeros((n, 3), np.float32),
        ids,
        np.where(ids[:, None] == 5, np.float32(1.0), np.float32(-1.0)) * np.ones(16, np.float32),
    )


def test_by_id(gaussians):
    np.testing.assert_array_equal(select(gaussians, 5, BY_ID), gaussians.object_ids == 5)
    assert not select(gaussians, 77).any()


def test_strays_are_cut(gaussians):
    chosen = select(gaussians, 5, SelectionConfig(adopt=False, cut_outliers=True))
    assert not chosen[298:300].any() and chosen[20:298].mean() > 0.98
    assert not select(gaussians, 77, SelectionConfig(cut_outliers=True, fill_hull=True)).any()


def test_the_hull_is_filled(gaussians):
    chosen = select(gaussians, 5, SelectionConfig(cut_outliers=True, fill_hull=True))
    assert chosen[:20].mean() > 0.5
    outside = (gaussians.means < -0.01).any(axis=1) | (gaussians.means > 1.01).any(axis=1)
    assert not chosen[outside].any()


def test_by_probability(gaussians):
    weights = np.stack([np.full(16, -1.0), np.full(16, 1.0)]).astype(np.float32)
    classifier = LinearClassifier(weights, np.zeros(2, np.float32), np.array([0, 5]))
    chosen = select(gaussians, 5, SelectionConfig(0.3, adopt=False), classifier=classifier)
    np.testing.assert_array_equal(chosen, gaussians.object_ids == 5)
    undecided = dataclasses.replace(gaussians, identities=np.zeros((len(gaussians), 16), np.float32))
    assert select(undecided, 5, SelectionConfig(0.3, adopt=False), classifier=classifier).all()
    assert not select(undecided, 5, SelectionConfig(0.6, adopt=False), classifier=classifier).any()


def test_what_is_missing_is_said(gaussians):
    with pytest.raises(ValueError, match="no object ids"):
        select(dataclasses.replace(gaussians, object_ids=None), 5)
    with pytest.raises(ValueError, match="classifier"):
        select(gaussians, 5, SelectionConfig(probability=0.3))


def test_orphans_are_adopted(gaussians):
    """Bits on a board that are called wall, while the wall is a metre away."""
    board = np.insert(np.mgrid[0:10, 0:10].reshape(2, -1).T * 0.02, 2, 0.0, axis=1)
    shifts = np.array([[0.005, 0.0, 0.01], [0.0, 0.0, 1.0], [0.2, 0.0, 0.0]])
    bits, wall, near = board[::10] + shifts[0], board + shifts[1], board + shifts[2]
    means = np.concatenate([board, bits, wall, near, np.full((1, 3), 7.0)])
    ids = np.repeat([5, 9, 9, 7, 0], [100, 10, 100, 100, 1]).astype(np.int32)
    rows = {name: array[: len(ids)] for name, array in gaussians.arrays().items()}
    map_ = Gaussians(**{**rows, "means": means.astype(np.float32), "object_ids": ids})
    found = orphans(map_, ids == 5)
    assert found[100:110].all() and found.sum() == 10  # not the neighbour, which touches
    np.testing.assert_array_equal(select(map_, 5), (ids == 5) | found)
    np.testing.assert_array_equal(select(map_, 5, BY_ID), ids == 5)
    assert not orphans(map_, ids == 77).any()
