# SPDX-License-Identifier: Apache-2.0
"""Arrays that are kept: the same memory while it suffices, more where it does not."""

import numpy as np
import warp as wp

from ggwarp.runtime.scratch import ScratchArrays


def test_what_suffices_is_used_again(device: str) -> None:
    scratch = ScratchArrays(device)
    first = scratch.take("points", 100, wp.vec3)
    assert first.shape == (100,) and first.dtype == wp.vec3 and first.device == wp.get_device(device)
    again = scratch.take("points", (5, 20), wp.vec3)
    assert again.shape == (5, 20) and again.ptr == first.ptr
    assert scratch.take("points", 110, wp.vec3).ptr == first.ptr, "a quarter more is there"
    assert scratch.take("others", 100, wp.vec3).ptr != first.ptr
    larger = scratch.take("points", 1000, wp.vec3)
    assert larger.shape == (1000,) and scratch.take("points", 3, wp.vec3).ptr == larger.ptr
    assert scratch.take("points", 3, wp.float32).dtype == wp.float32


def test_none_at_all(device: str) -> None:
    scratch = ScratchArrays(device)
    assert scratch.take("nothing", 0, wp.int32).shape == (0,)
    assert scratch.upload("nothing", np.zeros((0, 3), np.float32), wp.float32).shape == (0, 3)


def test_values_are_uploaded(device: str, rng: np.random.Generator) -> None:
    scratch = ScratchArrays(device)
    for shape in ((4, 6), (3, 2), (7, 9)):
        values = rng.normal(size=shape).astype(np.float32)
        np.testing.assert_array_equal(scratch.upload("image", values, wp.float32).numpy(), values)
    points = scratch.upload("points", rng.normal(size=(5, 3)).astype(np.float32), wp.vec3)
    assert points.shape == (5,) and points.dtype == wp.vec3
