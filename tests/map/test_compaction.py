# SPDX-License-Identifier: Apache-2.0
"""Dropping rows of arrays with spare capacity."""

import numpy as np
import warp as wp

from ggwarp.map.compaction import gathered, kept_indices


def test_drop_rows(device):
    rows = np.arange(30, dtype=np.float32).reshape(10, 3)
    flags = np.array([1, 0, 1, 1, 0, 0, 1, 1, 1, 1], np.int32)  # the last two lie beyond the count
    kept, indices = kept_indices(wp.array(flags, device=device), 8)
    out = gathered(wp.array(rows, dtype=wp.vec3, device=device), indices, kept)
    assert kept == 5 and out.shape == (10,)
    np.testing.assert_array_equal(out.numpy()[:kept], rows[[0, 2, 3, 6, 7]])


def test_all_none_and_empty(device):
    for flags, want in ((np.ones(4), 4), (np.zeros(4), 0), (np.zeros(0), 0)):
        kept, _ = kept_indices(wp.array(flags.astype(np.int32), device=device), len(flags))
        assert kept == want
