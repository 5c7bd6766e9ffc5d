# SPDX-License-Identifier: Apache-2.0
"""What the threads of a block need and Warp has no function for: vector loads, warps' votes, barriers.

On a CPU with ``wp.config.enable_cpu_blocks`` threads take turns between barriers. A warp's barrier is the
block's there, so that all warps have to come to as many: :func:`goes_on` is how a loop with one is written.
"""

import warp as wp

from ggwarp.kernels.math import vec16

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = *reinterpret_cast<const float4*>(data.data + i);
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
#else
    return data.data[i];
#endif
""")
def load4(data: wp.array[wp.vec4], i: int) -> wp.vec4:
    """Return a quad by one load; Warp's vectors promise an alignment of 4 bytes only."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(data.data + i) = make_float4(v[0], v[1], v[2], v[3]);
#else
    data.data[i] = v;
#endif
""")
def store4(data: wp.array[wp.vec4], i: int, v: wp.vec4):
    """Write a quad by one store."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4* quads = reinterpret_cast<const float4*>(data.data + i);
    wp::vec_t<16, float> v;
    for (int k = 0; k < 4; ++k) {
        const float4 q = quads[k];
        v[4 * k] = q.x;
        v[4 * k + 1] = q.y;
        v[4 * k + 2] = q.z;
        v[4 * k + 3] = q.w;
    }
    return v;
#else
    return data.data[i];
#endif
""")
def load16(data: wp.array[vec16], i: int) -> vec16:
    """Return a row by four loads instead of sixteen; ``data`` is contiguous."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float4* quads = reinterpret_cast<float4*>(data.data + i);
    for (int k = 0; k < 4; ++k)
        quads[k] = make_float4(v[4 * k], v[4 * k + 1], v[4 * k + 2], v[4 * k + 3]);
#else
    data.data[i] = v;
#endif
""")
def store16(data: wp.array[vec16], i: int, v: vec16):
    """Write a row by four stores instead of sixteen; ``data`` is contiguous."""
    ...


@wp.func_native("tile.data.ptr[i] = v;")
def put_quad(tile: wp.tile[wp.vec4], i: int, v: wp.vec4):
    """Write to shared memory, without a barrier."""
    ...


@wp.func_native("reinterpret_cast<float*>(tile.data.ptr)[i] = v;")
def put_float(tile: wp.tile[wp.vec4], i: int, v: float):
    """Write the i-th number of shared quads, without a barrier."""
    ...


@wp.func_native("tile.data.ptr[i] = v;")
def put_int(tile: wp.tile[int], i: int, v: int):
    """Write to shared memory, without a barrier."""
    ...


@wp.func_native("WP_TILE_SYNC();")
def sync_block():
    """Wait for the block's threads, and see what they wrote."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#else
    WP_TILE_SYNC();
#endif
""")
def sync_warp():
    """Wait for the warp's threads, and see what they wrote."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return left != 0;
#else
    return turn < turns;
#endif
""")
def goes_on(left: int, turn: int, turns: int) -> bool:
    """Whether a warp takes another turn: while something is left; on a CPU all take ``turns``, the most."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, yes) != 0;
#else
    return true;
#endif
""")
def any_in_warp(yes: bool) -> bool:
    """Whether any of the warp's threads says yes: a hint, always true on a CPU."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    WP_TILE_SYNC();
    tile.data.ptr[i] = v;
    WP_TILE_SYNC();
#endif
""")
def _leave(tile: wp.tile[wp.vec4], i: int, v: wp.vec4):
    """On a CPU, write what another thread asks for."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    wp::vec_t<4, float> found;
    for (int c = 0; c < 4; ++c)
        found[c] = __shfl_xor_sync(0xffffffffu, v[c], 16);
    return found;
#else
    return left;
#endif
""")
def _shuffled(v: wp.vec4, left: wp.vec4) -> wp.vec4: ...


@wp.func
def from_other_half(v: wp.vec4, scratch: wp.tile[wp.vec4], first: int, member: int) -> wp.vec4:
    """Return ``v`` of the thread that is 16 from this one in its warp; all of them call it.

    Args:
        scratch: 32 quads of the warp's from ``first`` on; written on a CPU alone.
        member: the thread's index in its warp.
    """
    _leave(scratch, first + member, v)
    return _shuffled(v, scratch[first + (member ^ 16)])


@wp.func_native("""
    const unsigned bit = 1u << (lane & 31);
#if defined(__CUDA_ARCH__)
    const unsigned votes = __ballot_sync(0xffffffffu, yes);
    if (bit == 1u)
        words.data.ptr[i] = static_cast<int>(votes);
#else
    const unsigned others = static_cast<unsigned>(words.data.ptr[i]) & ~bit;
    words.data.ptr[i] = static_cast<int>(yes ? others | bit : others);
#endif
""")
def vote(words: wp.tile[int], i: int, lane: int, yes: bool):
    """Write a shared word with a bit for each of the warp's threads; all of them call it."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(word) - 1;
#else
    return __builtin_ctz(static_cast<unsigned>(word));
#endif
""")
def lowest_bit(word: int) -> int:
    """Place of the lowest bit that is set; one is."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x * 1.4426950408889634f));
    return y;
#else
    return ::expf(x);
#endif
""")
def short_exp(x: float) -> float:
    """exp by one step of the hardware: relative error below 1e-6 for x in [-6, 1]."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __fdividef(x, y);
#else
    return x / y;
#endif
""")
def short_ratio(x: float, y: float) -> float:
    """x / y to 2 units in the last place, for y of moderate size."""
    ...
