# SPDX-License-Identifier: Apache-2.0
import numpy as np
import warp as wp

from ggwarp.kernels.identity import random
from ggwarp.kernels.raster.sampling import Sample
from ggwarp.kernels.registration import hash_grid


def phases(device: str, seed: int, count: int, stride: int = 4) -> np.ndarray:
    done, phase = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
    drawn = []
    for _ in range(count):
        random.draw_sample(Sample(stride, phase), seed=seed, draws=done, device=device)
        drawn.append(int(phase.numpy()[0]))
    assert done.numpy()[0] == count
    return np.array(drawn)


def test_phases_are_even_and_repeat(device):
    drawn = phases(device, 3, 800)
    counts = np.bincount(drawn, minlength=4)
    assert len(counts) == 4 and (abs(counts - 200) < 60).all()  # five standard deviations
    assert (drawn == phases(device, 3, 800)).all()
    assert (drawn != phases(device, 4, 800)).any()
    followers = np.bincount(4 * drawn[:-1] + drawn[1:], minlength=16)
    assert (abs(followers - 50) < 35).all()


def test_none_may_be_drawn(device):
    done, phase = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
    random.draw_sample(Sample(4, phase), seed=3, draws=done, none=True, device=device)
    assert phase.numpy()[0] < 0


def points(device: str, xyz: np.ndarray, draw: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    grid = hash_grid.allocate_hash_grid(len(xyz) + 5, device=device)
    hash_grid.build_hash_grid(grid, wp.array(xyz, dtype=wp.vec3, device=device), cell_size=0.3, device=device)
    indices = wp.empty(m, dtype=int, device=device)
    positions = wp.empty(m, dtype=wp.vec3, device=device)
    random.draw_points(grid, seed=7, draw=draw, indices=indices, points=positions, device=device)
    return indices.numpy(), positions.numpy()


def test_points_are_drawn_evenly_with_their_positions(device, rng):
    xyz = rng.normal(size=(40, 3)).astype(np.float32)
    indices, positions = points(device, xyz, 0, 4000)
    assert (xyz[indices] == positions).all()
    counts = np.bincount(indices, minlength=40)
    assert len(counts) == 40 and (abs(counts - 100) < 50).all()
    assert (points(device, xyz, 0, 4000)[0] == indices).all()
    assert (points(device, xyz, 1, 4000)[0] != indices).mean() > 0.9


def test_a_single_point_is_always_drawn(device):
    indices, _ = points(device, np.zeros((1, 3), np.float32), 2**20, 5000)
    assert not indices.any()
