# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.geometry.distinct import counted, ranked


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64])
@pytest.mark.parametrize("apart", [1, 10**7], ids=["dense", "sparse"])
@pytest.mark.parametrize("shape", [(7, 5), (1,), (0,), (3, 0)])
def test_integers_are_told_apart_as_numpy_does(
    dtype: type, apart: int, shape: tuple[int, ...], rng: np.random.Generator
) -> None:
    values = rng.integers(0, 7, shape).astype(dtype) * dtype(apart % np.iinfo(dtype).max)
    values = values - dtype(3) if dtype is not np.uint8 else values
    expected, numbers = np.unique(values, return_counts=True)
    distinct, ranks = ranked(values)
    assert distinct.dtype == values.dtype and np.array_equal(distinct, expected)
    assert np.array_equal(distinct[ranks], values)
    distinct, counts = counted(values.ravel())
    assert distinct.dtype == values.dtype and np.array_equal(distinct, expected)
    assert np.array_equal(counts, numbers)


def test_integers_at_both_ends_do_not_overflow() -> None:
    ends = np.array([np.iinfo(np.int32).max, np.iinfo(np.int32).min, 5], np.int32)
    assert ranked(ends)[1].tolist() == [2, 0, 1] and counted(ends)[1].tolist() == [1, 1, 1]
