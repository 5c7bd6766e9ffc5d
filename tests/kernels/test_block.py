# SPDX-License-Identifier: Apache-2.0
"""What threads of a block do together, on a CPU whose threads take turns."""

import numpy as np
import pytest
import warp as wp

from ggwarp.kernels.block import (
    any_in_warp,
    from_other_half,
    goes_on,
    load4,
    load16,
    lowest_bit,
    put_float,
    put_int,
    put_quad,
    short_exp,
    short_ratio,
    store4,
    store16,
    sync_block,
    sync_warp,
    vote,
)
from ggwarp.kernels.math import vec16


@wp.kernel(enable_backward=False)
def votes_kernel(said: wp.array[int], words: wp.array[int], turns: wp.array[int]):
    _block, lane = wp.tid()
    shared = wp.tile_empty(shape=2, dtype=int, storage="shared")
    vote(shared, lane >> 5, lane, said[lane] != 0)
    sync_block()
    word = shared[lane >> 5]
    if (lane & 31) == 0:
        words[lane >> 5] = word
    bits = wp.int32(0)
    bits += word
    turn = wp.int32(0)
    place = wp.int32(0)
    while goes_on(bits, turn, 32):
        turn += 1
        if not any_in_warp(True):
            break
        if bits != 0:
            place += lowest_bit(bits)
            bits = bits & (bits - 1)
        sync_warp()
    turns[lane] = place


@wp.kernel(enable_backward=False)
def quads_kernel(data: wp.array[wp.vec4], out: wp.array[wp.vec4]):
    _block, lane = wp.tid()
    shared = wp.tile_empty(shape=64, dtype=wp.vec4, storage="shared")
    place = wp.tile_empty(shape=64, dtype=int, storage="shared")
    put_quad(shared, 63 - lane, load4(data, lane))
    put_int(place, lane, 63 - lane)
    sync_block()
    put_float(shared, 4 * lane + 3, 7.0)
    sync_block()
    v = shared[place[lane]]
    sync_block()
    store4(out, lane, v + from_other_half(v, shared, lane & 32, lane & 31))


@wp.kernel(enable_backward=False)
def rows_kernel(data: wp.array[vec16], out: wp.array[vec16]):
    i = wp.tid()
    store16(out, i, load16(data, data.shape[0] - 1 - i) * 2.0)


@wp.kernel(enable_backward=False)
def short_kernel(x: wp.array[float], exps: wp.array[float], ratios: wp.array[float]):
    i = wp.tid()
    exps[i] = short_exp(x[i])
    ratios[i] = short_ratio(x[i], 1.5 + x[i] * 0.2)


@pytest.fixture
def blocks_on_cpu(monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)


def test_a_vote_is_a_bit_a_thread(blocks_on_cpu, device, rng):
    said = rng.integers(0, 2, 64).astype(np.int32)
    words, turns = (wp.full(n, -1, dtype=int, device=device) for n in (2, 64))
    votes = wp.array(said, device=device)
    wp.launch_tiled(votes_kernel, dim=1, inputs=[votes], outputs=[words, turns], block_dim=64, device=device)
    for warp, word in enumerate(words.numpy().view(np.uint32)):
        mine = said[32 * warp : 32 * warp + 32]
        assert [(word >> k) & 1 for k in range(32)] == mine.tolist()
        assert (turns.numpy()[32 * warp : 32 * warp + 32] == np.flatnonzero(mine).sum()).all()


def test_quads_move_through_shared_memory_and_between_halves(blocks_on_cpu, device, rng):
    values = rng.normal(size=(64, 4)).astype(np.float32)
    data, out = wp.array(values, dtype=wp.vec4, device=device), wp.zeros(64, dtype=wp.vec4, device=device)
    wp.launch_tiled(quads_kernel, dim=1, inputs=[data], outputs=[out], block_dim=64, device=device)
    values[:, 3] = 7.0
    assert np.array_equal(out.numpy(), values + values[np.arange(64) ^ 16])


def test_rows_are_read_and_written_whole(device, rng):
    values = rng.normal(size=(9, 16)).astype(np.float32)
    data, out = wp.array(values, dtype=vec16, device=device), wp.zeros(9, dtype=vec16, device=device)
    wp.launch(rows_kernel, dim=9, inputs=[data], outputs=[out], device=device)
    assert np.array_equal(out.numpy(), 2.0 * values[::-1])


def test_short_forms_are_close(device):
    x = np.linspace(-6.0, 1.0, 999).astype(np.float32)
    exps, ratios = (wp.zeros(999, dtype=float, device=device) for _ in range(2))
    wp.launch(
        short_kernel, dim=999, inputs=[wp.array(x, device=device)], outputs=[exps, ratios], device=device
    )
    np.testing.assert_allclose(exps.numpy(), np.exp(x.astype(np.float64)), rtol=1e-6)
    np.testing.assert_allclose(ratios.numpy(), x / (1.5 + x * np.float32(0.2)), rtol=5e-7, atol=1e-12)
