# SPDX-License-Identifier: Apache-2.0
"""Pruning flags, indices of kept rows and the gather of rows, against NumPy."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim import compact
from ggwarp.kernels.optim.adam import GaussianArrays

TYPES = {
    "int": (wp.int32, 0),
    "float": (wp.float32, 0),
    "vec3": (wp.vec3, 3),
    "vec4": (wp.vec4, 4),
    "vec16": (vec16, 16),
}
FIELDS = [("means", wp.vec3, 3), ("quats", wp.vec4, 4), ("log_scales", wp.vec3, 3),
          ("opacity_logits", wp.float32, 0), ("colours", wp.vec3, 3), ("identities", vec16, 16)]  # fmt: skip


def healthy(n):
    values = {name: np.ones((n, width) if width else n, np.float32) for name, _, width in FIELDS}
    values["log_scales"][:] = np.log(0.05)
    return values


def flags_of(values, device, n=None, **options):
    n = len(values["means"]) if n is None else n
    arrays = GaussianArrays(
        **{name: wp.array(values[name], dtype=t, device=device) for name, t, _ in FIELDS if name in values}
    )
    flags = wp.full(n, 9, dtype=wp.int32, device=device)
    compact.flag_kept(arrays, flags=flags, device=device, **options)
    return flags.numpy()


def kept(flags, device):
    n = len(flags)
    positions, indices = (wp.zeros(n, dtype=wp.int32, device=device) for _ in range(2))
    flags = wp.array(flags.astype(np.int32), device=device)
    compact.index_kept(flags, positions=positions, indices=indices, device=device)
    count = int(positions.numpy()[-1]) if n else 0
    return count, indices


def test_flags_opacity_and_scale(device):
    values = healthy(5)
    values["opacity_logits"][:] = [np.log(p / (1 - p)) for p in (0.004, 0.006, 0.9, 0.9, 0.9)]
    values["log_scales"][3, 1] = np.log(0.26)
    values["log_scales"][4, 2] = np.log(0.24)
    np.testing.assert_array_equal(flags_of(values, device, max_scale=0.25), [0, 1, 1, 0, 1])
    np.testing.assert_array_equal(flags_of(values, device), [0, 1, 1, 1, 1])
    np.testing.assert_array_equal(flags_of(values, device, min_opacity=0.0), 1)
    np.testing.assert_array_equal(flags_of(values, device, n=2), [0, 1])


def test_flags_drop_what_is_idle_for_too_long(device):
    low_weight_counts = wp.array([0, 4, 5, 6], dtype=wp.int32, device=device)
    np.testing.assert_array_equal(
        flags_of(healthy(4), device, low_weight_counts=low_weight_counts, most_low_weight_counts=5),
        [1, 1, 0, 0],
    )


@pytest.mark.parametrize("n", [0, 1, 3000])
def test_idle_views_are_counted_in_a_row(device, rng, n):
    ranks = rng.integers(-1, 2, n).astype(np.int32)
    weights = rng.choice(np.array([0.0, 0.09, 0.1, 5.0, np.nan], np.float32), n)
    low_weight_counts = rng.integers(0, 9, n + 5).astype(np.int32)
    expected = low_weight_counts.copy()
    for i in range(n):
        if ranks[i] >= 0:
            expected[i] = low_weight_counts[i] + 1 if weights[i] < np.float32(0.1) else 0
    counted = wp.array(low_weight_counts, device=device)
    compact.count_low_weight(
        wp.array(weights, device=device),
        ranks=wp.array(ranks, device=device),
        least_weight=0.1,
        low_weight_counts=counted,
        device=device,
    )
    np.testing.assert_array_equal(counted.numpy(), expected)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", [name for name, _, _ in FIELDS])
def test_flags_drop_what_is_not_finite(device, name, bad):
    values = healthy(3)
    values[name].reshape(3, -1)[1, -1] = bad
    np.testing.assert_array_equal(flags_of(values, device), [1, 0, 1])


def test_flags_without_identities_and_with_a_zero_quaternion(device):
    values = healthy(2)
    del values["identities"]
    values["quats"][0] = 0.0
    np.testing.assert_array_equal(flags_of(values, device), [0, 1])


@settings(max_examples=20)
@given(n=st.integers(0, 3000), share=st.sampled_from([0.0, 0.1, 0.5, 1.0]), seed=st.integers(0, 99))
def test_kept_rows_in_order(n, share, seed):
    flags = np.random.default_rng(seed).random(n) < share
    count, indices = kept(flags, "cpu")
    np.testing.assert_array_equal(indices.numpy()[:count], np.flatnonzero(flags))


@pytest.mark.parametrize("kind", list(TYPES))
def test_gather_moves_bits(rng, device, kind):
    dtype, width = TYPES[kind]
    n = 2500
    bits = rng.integers(-(2**31), 2**31, (n, width) if width else n, dtype=np.int64).astype(np.int32)
    rows = bits if dtype is wp.int32 else bits.view(np.float32)  # NaN payloads included
    flags = rng.random(n) < 0.4
    count, indices = kept(flags, device)
    out = wp.zeros(n, dtype=dtype, device=device)
    compact.gather_rows(
        wp.array(rows, dtype=dtype, device=device), indices, count=count, out=out, device=device
    )
    got = out.numpy().view(np.int32)
    np.testing.assert_array_equal(got[:count], bits[flags])
    assert not got[count:].any()


def test_gather_nothing(device):
    source, indices = wp.zeros(0, dtype=wp.vec3, device=device), wp.zeros(0, dtype=wp.int32, device=device)
    compact.gather_rows(source, indices, count=0, out=source, device=device)
    assert kept(np.zeros(0, bool), device)[0] == 0
