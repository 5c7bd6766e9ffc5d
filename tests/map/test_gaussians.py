# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys

import numpy as np
import pytest

from ggwarp.map.gaussians import Gaussians, join


def some(count: int, rng: np.random.Generator, **more: np.ndarray) -> Gaussians:
    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    return Gaussians(draw(3), draw(4), draw(3), draw(), draw(3), **more)


def test_rows_are_taken_by_flag_and_by_number(rng: np.random.Generator) -> None:
    gaussians = some(4, rng, object_ids=np.arange(4, dtype=np.int32))
    assert set(gaussians.arrays()) == {
        *("means", "quats", "log_scales", "opacity_logits", "colours", "object_ids")
    }
    flagged = gaussians.take(np.array([True, False, False, True]))
    numbered = gaussians.take(np.array([3, 0, 3]))
    for name, rows in gaussians.arrays().items():
        np.testing.assert_array_equal(getattr(flagged, name), rows[[0, 3]])
        np.testing.assert_array_equal(getattr(numbered, name), rows[[3, 0, 3]])
    assert numbered.identities is None and len(numbered) == 3 and len(gaussians.take(np.zeros(4, bool))) == 0


def test_joined_they_keep_their_order(rng: np.random.Generator) -> None:
    first, second = (some(n, rng, votes=np.full(n, n, np.int32)) for n in (2, 3))
    both = join(first, second)
    np.testing.assert_array_equal(both.means, np.concatenate([first.means, second.means]))
    assert both.votes is not None and both.votes.tolist() == [2, 2, 3, 3, 3]
    np.testing.assert_array_equal(join(first).quats, first.quats)


def test_maps_that_know_different_things_are_not_joined(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="only some of the maps have votes"):
        join(some(2, rng), some(2, rng, votes=np.zeros(2, np.int32)))


def test_reading_a_map_loads_no_kernels() -> None:
    code = "import sys, ggwarp.io.ply; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not set(done.stdout.split()) & {"warp", "torch", "cv2"}
