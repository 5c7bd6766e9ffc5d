# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry.voxels import ranked_voxels, voxel_centres, voxel_keys


@pytest.mark.parametrize("size", [0.1, 0.25])
def test_a_point_lies_in_its_cell(size: float, rng: np.random.Generator) -> None:
    points = rng.uniform(-500.0, 500.0, (1000, 3))
    numbers = voxel_keys(points, size)
    middles = voxel_centres(numbers, size)
    assert np.abs(middles - points).max() <= 0.5 * size + 1e-9
    np.testing.assert_array_equal(voxel_keys(middles, size), numbers)
    assert len(np.unique(numbers)) == len(np.unique(np.floor(points / size), axis=0))


@pytest.mark.parametrize("reach", [3.0, 500.0, 90_000.0], ids=["a room", "a street", "past the keys"])
def test_voxels_are_ranked_as_their_keys(reach: float, rng: np.random.Generator) -> None:
    points = rng.uniform(-reach, reach, (2000, 3))
    points[:1000] = np.abs(points[:1000]) % 1.0
    keys, ranks = ranked_voxels(points.T, 0.1)
    expected, places = np.unique(voxel_keys(points, 0.1), return_inverse=True)
    np.testing.assert_array_equal(keys, expected)
    np.testing.assert_array_equal(ranks, places)
    assert [len(part) for part in ranked_voxels(np.empty((3, 0)), 0.1)] == [0, 0]


def test_no_points_no_cells() -> None:
    assert voxel_keys(np.empty((0, 3)), 0.1).shape == (0,)
    assert voxel_centres(np.empty(0, np.int64), 0.1).shape == (0, 3)
