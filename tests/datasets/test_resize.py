# SPDX-License-Identifier: Apache-2.0
"""Reduced depth never mixes surfaces; reduced labels never mix ids."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.datasets.resize import reduce_depth, resize_nearest


def reduce_by_definition(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return what :func:`reduce_depth` promises, pixel by pixel in float64, and where it is at an edge."""
    H, W = depth.shape
    out = np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            rows = np.arange(y * H // height, -(-(y + 1) * H // height))
            columns = np.arange(x * W // width, -(-(x + 1) * W // width))
            patch = depth[np.ix_(rows, columns)].astype(np.float64)
            overlap_v = np.minimum(rows + 1, (y + 1) * H / height) - np.maximum(rows, y * H / height)
            overlap_u = np.minimum(columns + 1, (x + 1) * W / width) - np.maximum(columns, x * W / width)
            weights = np.outer(overlap_v, overlap_u) * (patch > 0)
            if not weights.any():
                continue
            mean = (weights * patch).sum() / weights.sum()
            valid = patch[patch > 0]
            if valid.max() - valid.min() < 0.02 * mean:
                out[y, x] = mean
            else:
                v, u = np.meshgrid(rows - rows.mean(), columns - columns.mean(), indexing="ij")
                out[y, x] = patch.ravel()[np.where(patch > 0, v**2 + u**2, np.inf).argmin()]
    return out


@settings(max_examples=60)
@given(
    height=st.integers(1, 17),
    width=st.integers(1, 19),
    fraction=st.floats(0.05, 1.0),
    seed=st.integers(0, 1000),
)
def test_depth_is_reduced_as_defined(height: int, width: int, fraction: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    near_far = np.where(rng.random((height, width)) < 0.8, 1.5, 3.0)
    depth = near_far * (1 + 0.004 * rng.random((height, width))) * (rng.random((height, width)) < 0.8)
    depth = depth.astype(np.float32)
    w, h = max(1, round(width * fraction)), max(1, round(height * fraction))
    got = reduce_depth(depth, w, h)
    assert got.shape == (h, w) and got.dtype == np.float32
    np.testing.assert_allclose(got, reduce_by_definition(depth, w, h), rtol=2e-5)


def test_a_mean_leaves_out_what_was_not_read() -> None:
    depth = np.array([[1.0, 0.0], [1.01, 0.0]], np.float32)
    np.testing.assert_allclose(reduce_depth(depth, 1, 1), [[1.005]], rtol=1e-6)


def test_an_edge_keeps_one_of_its_sides() -> None:
    depth = np.ones((4, 4), np.float32)
    depth[:, 1:] = 3.0
    assert set(np.unique(reduce_depth(depth, 2, 2))) <= {1.0, 3.0}


def test_an_empty_image_stays_empty() -> None:
    assert not reduce_depth(np.zeros((6, 6), np.float32), 3, 3).any()


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (7, 5), (14, 10)])
def test_labels_are_those_of_the_nearest_pixel(size: tuple[int, int]) -> None:
    labels = np.arange(35).reshape(5, 7)
    width, height = size
    got = resize_nearest(labels, width, height)
    want = [
        [labels[int((v + 0.5) * 5 / height), int((u + 0.5) * 7 / width)] for u in range(width)]
        for v in range(height)
    ]
    np.testing.assert_array_equal(got, want)
