# SPDX-License-Identifier: Apache-2.0
"""Small arrays that go to the device and come back together."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from ggwarp.kernels.math import mat66d
from ggwarp.runtime.packed_arrays import PackedArrays, as_rows, numpy_type


@wp.struct
class Row:
    matrix: mat66d
    count: int
    values: wp.array[wp.float32]


@wp.kernel
def _scaled(rows: wp.array[Row], poses: wp.array[wp.mat44d], out: wp.array[wp.float64]):
    r = wp.tid()
    row = rows[r]
    total = row.matrix[5, 4] + poses[r][0, 3]
    for k in range(row.count):
        total += wp.float64(row.values[k])
    out[r] = total


def packed(device: str) -> PackedArrays:
    number: Any = wp.float64
    row: Any = Row
    return PackedArrays(
        {"flag": (wp.int32, 1), "rows": (row, 2), "poses": (wp.mat44d, 2), "out": (number, 2)}, device
    )


def test_what_is_written_is_read_by_kernels_and_comes_back(device: str, rng: np.random.Generator) -> None:
    arrays, values = packed(device), rng.random((2, 3)).astype(np.float32)
    matrices, poses = rng.random((2, 6, 6)), rng.random((2, 4, 4))
    kept, structs = [wp.array(v, dtype=float, device=device) for v in values], []
    for matrix, array in zip(matrices, kept, strict=True):
        struct: Any = Row()
        struct.matrix, struct.count, struct.values = mat66d(*matrix.ravel().tolist()), 3, array
        structs.append(struct)
    arrays.host["rows"][:], arrays.host["poses"][:] = as_rows(Row, structs), poses
    arrays.host["out"][:] = -1.0
    arrays.upload()
    d = arrays.device
    wp.launch(_scaled, dim=2, inputs=[d["rows"], d["poses"]], outputs=[d["out"]], device=device)
    found = arrays.read()
    expected = matrices[:, 5, 4] + poses[:, 0, 3] + values.astype(np.float64).sum(axis=1)
    np.testing.assert_allclose(found["out"], expected, rtol=1e-12)
    np.testing.assert_array_equal(found["poses"], poses)
    np.testing.assert_array_equal(found["rows"]["matrix"], matrices)
    assert (arrays.host["out"] == -1.0).all(), "the image is as it was written"
    arrays.upload()
    assert (arrays.read()["out"] == -1.0).all() and (found["out"] > 0.0).all(), "what was read stays"


def test_arrays_outlive_what_made_them(device: str) -> None:
    out = packed(device).device["out"]
    out.fill_(3.0)
    assert (out.numpy() == 3.0).all()


@pytest.mark.parametrize(
    ("dtype", "expected"),
    [(wp.float64, "f8"), (wp.vec3, "(3,)f4"), (mat66d, "(6,6)f8"), (wp.uint8, "u1")],
)
def test_types_are_numpy_s(dtype: Any, expected: str) -> None:
    assert numpy_type(dtype) == np.dtype(expected)
