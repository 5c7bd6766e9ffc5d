# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry.voxels import labelled_voxels, voxel_centres, voxel_keys


@pytest.mark.parametrize("size", [0.1, 0.25])
def test_a_point_lies_in_its_cell(size: float, rng: np.random.Generator) -> None:
    points = rng.uniform(-500.0, 500.0, (1000, 3))
    numbers = voxel_keys(points, size)
    middles = voxel_centres(numbers, size)
    assert np.abs(middles - points).max() <= 0.5 * size + 1e-9
    np.testing.assert_array_equal(voxel_keys(middles, size), numbers)
    assert len(np.unique(numbers)) == len(np.unique(np.floor(points / size), axis=0))


@pytest.mark.parametrize("reach", [3.0, 500.0, 90_000.0], ids=["a room", "a street", "past the keys"])
@pytest.mark.parametrize("most", [5, 2**20], ids=["few labels", "many labels"])
def test_points_are_counted_by_label_and_voxel(reach: float, most: int, rng: np.random.Generator) -> None:
    points = rng.uniform(-reach, reach, (2000, 3))
    points[:1000] = np.abs(points[:1000]) % 1.0
    labels = rng.integers(-3, most, 2000).astype(np.int32)
    known = labels >= 0
    rows = np.stack([labels[known], voxel_keys(points[known], 0.1)], axis=1)
    expected, numbers = np.unique(rows, axis=0, return_counts=True)
    owners, keys, counts = labelled_voxels(points.T, labels, 0.1)
    np.testing.assert_array_equal(np.stack([owners, keys], axis=1), expected)
    np.testing.assert_array_equal(counts, numbers)


def test_points_without_labels_are_in_no_voxel(rng: np.random.Generator) -> None:
    nowhere = labelled_voxels(np.empty((3, 0)), np.empty(0, np.int32), 0.1)
    unknown = labelled_voxels(rng.uniform(-1.0, 1.0, (3, 9)), np.full(9, -1, np.int32), 0.1)
    assert [len(part) for part in (*nowhere, *unknown)] == [0] * 6


def test_no_points_no_cells() -> None:
    assert voxel_keys(np.empty((0, 3)), 0.1).shape == (0,)
    assert voxel_centres(np.empty(0, np.int64), 0.1).shape == (0, 3)
