# SPDX-License-Identifier: Apache-2.0
"""Reduced depth never mixes surfaces; reduced labels never mix ids."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.datasets.resize import enlarge_depth, reduce_depth, resize_labels, resize_nearest


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


@pytest.mark.parametrize(("size", "target"), [((24, 36), (6, 9)), ((24, 36), (12, 18)), ((25, 38), (6, 9))])
def test_what_fills_most_of_a_footprint_is_its_label(size: tuple[int, int], target: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    labels = np.kron(rng.integers(0, 5, (5, 4)), np.ones((5, 10), int))[: size[0], : size[1]].astype(np.int32)
    small = resize_labels(labels, target[1], target[0])
    fy, fx = size[0] / target[0], size[1] / target[1]
    for y in range(target[0]):
        for x in range(target[1]):
            rows = ((y + (np.arange(40) + 0.5) / 40) * fy).astype(int)
            columns = ((x + (np.arange(40) + 0.5) / 40) * fx).astype(int)
            counts = np.bincount(labels[rows[:, None], columns].ravel(), minlength=5)
            assert counts[small[y, x]] >= counts.max() - 0.25 * counts.sum()


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_no_border_moves_when_labels_shrink(factor: int) -> None:
    """The nearest pixel of an even footprint lies half a pixel off its middle, always to the same side."""
    moved = {resize_labels: [], resize_nearest: []}
    for column in range(40, 80):
        labels = np.zeros((60, 120), np.int32)
        labels[:, column:] = 1
        for resize, offsets in moved.items():
            small = resize(labels, 120 // factor, 60 // factor)
            offsets.append((1.0 - small.mean()) * 120 - column)
    assert abs(np.mean(moved[resize_labels])) < 0.05
    if factor % 2 == 0:
        assert abs(np.mean(moved[resize_nearest])) > 0.4


def test_labels_that_grow_are_the_nearest() -> None:
    labels = np.arange(6, dtype=np.int32).reshape(2, 3)
    np.testing.assert_array_equal(resize_labels(labels, 6, 4), np.kron(labels, np.ones((2, 2), int)))
    assert resize_labels(labels, 3, 2) is labels


@pytest.mark.parametrize("slope", [0.0, 0.02, 0.06])
def test_a_slanted_plane_stays_one_when_depth_is_enlarged(slope: float) -> None:
    """Inverse depth that falls by up to 2 % of its start a pixel, and at last by 6 % of itself."""
    v, u = np.mgrid[:24, :32]
    small = (1.0 / (1.0 - slope * u / 3.0 + 0.01 * v)).astype(np.float32)
    at_v, at_u = (np.mgrid[:96, :128] + 0.5) / 4.0 - 0.5
    want = 1.0 / (1.0 - slope * at_u / 3.0 + 0.01 * at_v)
    inner = np.s_[4:-4, 4:-4]
    np.testing.assert_allclose(enlarge_depth(small, 128, 96)[inner], want[inner], rtol=1e-4)


def test_two_slanted_surfaces_are_not_mixed() -> None:
    u = np.tile(np.arange(32.0), (24, 1))
    near, far = 1.0 / (1.0 - 0.015 * u), 2.0 / (1.0 - 0.015 * u)
    small = np.where(u < 16, near, far).astype(np.float32)
    large = enlarge_depth(small, 128, 96)
    ratio = large[48] * (1.0 - 0.015 * ((np.arange(128) + 0.5) / 4.0 - 0.5))
    assert (np.minimum(np.abs(ratio - 1.0), np.abs(ratio / 2.0 - 1.0)) < 0.02).all()
