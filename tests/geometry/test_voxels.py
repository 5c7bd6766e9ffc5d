# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry.voxels import voxel_centres, voxel_keys


@pytest.mark.parametrize("size", [0.1, 0.25])
def test_a_point_lies_in_its_cell(size: float, rng: np.random.Generator) -> None:
    points = rng.uniform(-500.0, 500.0, (1000, 3))
    numbers = voxel_keys(points, size)
    middles = voxel_centres(numbers, size)
    assert np.abs(middles - points).max() <= 0.5 * size + 1e-9
    np.testing.assert_array_equal(voxel_keys(middles, size), numbers)
    assert len(np.unique(numbers)) == len(np.unique(np.floor(points / size), axis=0))


def test_no_points_no_cells() -> None:
    assert voxel_keys(np.empty((0, 3)), 0.1).shape == (0,)
    assert voxel_centres(np.empty(0, np.int64), 0.1).shape == (0, 3)
