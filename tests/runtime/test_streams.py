# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import warp as wp

from ggwarp.runtime.streams import Backlog, to_host


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64, wp.int32, wp.uint8])
def test_to_host(device, rng, dtype):
    values = (100 * rng.random((7, 5))).astype(wp.dtype_to_numpy(dtype))
    host = to_host(wp.array(values, dtype=dtype, device=device))
    assert host.dtype == values.dtype
    np.testing.assert_array_equal(host, values)


def test_to_host_of_parts_and_vectors(device, rng):
    values = rng.random((9, 3)).astype(np.float32)
    array = wp.array(values, dtype=wp.vec3, device=device)
    np.testing.assert_array_equal(to_host(array[1:8:2]), values[1:8:2])
    assert to_host(array[:0]).shape[0] == 0


def test_a_backlog_lets_work_through(device):
    array = wp.zeros(1, dtype=int, device=device)
    backlog = Backlog(device, limit=2)
    for i in range(7):
        array.fill_(i)
        backlog.added()
    assert to_host(array)[0] == 6
