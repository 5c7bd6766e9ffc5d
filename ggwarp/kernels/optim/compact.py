# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians stay, and moving the rows of those that do; order is kept.

Appending needs no kernel: ``wp.copy`` with ``dest_offset`` does it.
"""

import math
from typing import Any

import warp as wp

from ggwarp.kernels.math import vec16
from ggwarp.kernels.optim.adam import GaussianArrays
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _flags_kernel(
    offset: int,
    with_identity: int,
    least_logit: float,
    largest_log_scale: float,
    most_low_weight_counts: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    colours: wp.array[wp.vec3],
    identities: wp.array[vec16],
    low_weight_counts: wp.array[wp.int32],
    flags: wp.array[wp.int32],
):
    i = offset + wp.tid()
    s = log_scales[i]
    q = quats[i]
    logit = opacity_logits[i]
    # Comparisons with NaN are false, so each asks for what must hold.
    keep = logit >= least_logit and wp.max(s) <= largest_log_scale and wp.dot(q, q) > 0.0
    finite = wp.isfinite(means[i]) and wp.isfinite(q) and wp.isfinite(s) and wp.isfinite(logit)
    finite = finite and wp.isfinite(colours[i])
    if with_identity != 0:
        finite = finite and wp.isfinite(identities[i])
    if low_weight_counts:
        keep = keep and low_weight_counts[i] < most_low_weight_counts
    flags[i] = wp.where(keep and finite, 1, 0)


@wp.kernel
def _low_weight_kernel(
    offset: int,
    least_weight: float,
    ranks: wp.array[wp.int32],
    weights: wp.array[wp.float32],
    low_weight_counts: wp.array[wp.int32],
):
    i = offset + wp.tid()
    if ranks[i] >= 0:
        low_weight_counts[i] = wp.where(weights[i] < least_weight, low_weight_counts[i] + 1, 0)


@wp.kernel
def _indices_kernel(flags: wp.array[wp.int32], positions: wp.array[wp.int32], indices: wp.array[wp.int32]):
    i = wp.tid()
    if flags[i] != 0:
        indices[positions[i] - 1] = i


@wp.kernel
def _gather_kernel(
    offset: int,
    indices: wp.array[wp.int32],
    source: wp.array2d[wp.int32],
    out: wp.array2d[wp.int32],
):
    row = offset + wp.tid()
    i = indices[row]
    for word in range(source.shape[1]):
        out[row, word] = source[i, word]


def _words(array: Any) -> Any:
    """View the rows of any array of 32-bit numbers as int32 words: one kernel moves every type."""
    rows = array.shape[0]
    width = wp.types.type_size_in_bytes(array.dtype) // 4
    for extent in array.shape[1:]:
        width *= extent
    view = wp.array(ptr=array.ptr, dtype=wp.int32, shape=(rows, width), device=array.device)
    view._ref = array
    return view


def flag_kept(
    parameters: GaussianArrays,
    *,
    flags: Any,
    min_opacity: float = 0.005,
    max_scale: float = math.inf,
    low_weight_counts: Any = None,
    most_low_weight_counts: int = 0,
    device: Any,
) -> None:
    """Flag the Gaussians worth keeping: opaque and small enough, all numbers finite.

    Args:
        parameters: [>= n] arrays.
        flags: [n] int, written: 1 = keep, 0 = drop.
        min_opacity: those more transparent go.
        max_scale: those with a longer axis (standard deviation, metres) go.
        low_weight_counts: [>= n] int; those with ``most_low_weight_counts`` or more go;
            None: it does not matter.
        device: a Warp device.
    """
    p = parameters
    least_logit = math.log(min_opacity / (1.0 - min_opacity)) if min_opacity > 0.0 else -math.inf
    launch_split(
        _flags_kernel,
        flags.shape[0],
        inputs=[
            *(int(p.identities is not None), least_logit, math.log(max_scale), most_low_weight_counts),
            *(p.means, p.quats, p.log_scales, p.opacity_logits, p.colours, p.identities, low_weight_counts),
        ],
        outputs=[flags],
        device=device,
        min_piece=1024,
    )


def count_low_weight(
    weights: Any, *, ranks: Any, least_weight: float, low_weight_counts: Any, device: Any
) -> None:
    """Count for how many views in a row each Gaussian made up next to nothing of those that could show it.

    Args:
        weights: [>= n] float, pixels that each makes up of a view, where it is visible.
        ranks: [n] int, negative: not visible; its count stays.
        least_weight: fewer pixels than this count for nothing.
        low_weight_counts: [>= n] int, in and out: one more, or back to 0.
        device: a Warp device.
    """
    launch_split(
        _low_weight_kernel,
        ranks.shape[0],
        inputs=[least_weight, ranks, weights],
        outputs=[low_weight_counts],
        device=device,
        min_piece=1024,
    )


def index_kept(flags: Any, *, positions: Any, indices: Any, device: Any) -> None:
    """List the flagged rows in order.

    Args:
        flags: [n] int, 1 = keep, 0 = drop.
        positions: [n] int, written: inclusive sums of ``flags``; the last is the number kept.
        indices: [n] int, written: row numbers of those kept, then rubbish.
        device: a Warp device.
    """
    if flags.shape[0] == 0:
        return
    wp.utils.array_scan(flags, positions, inclusive=True)
    wp.launch(_indices_kernel, dim=flags.shape[0], inputs=[flags, positions, indices], device=device)


def gather_rows(source: Any, indices: Any, *, count: int, out: Any, device: Any) -> None:
    """Copy rows: ``out[i] = source[indices[i]]`` for i < count; further rows of ``out`` stay.

    Args:
        source: [m, ...] contiguous array of any type made of 32-bit numbers.
        indices: [>= count] int.
        count: rows to copy.
        out: [>= count, ...] contiguous, of the same type; not ``source``.
        device: a Warp device.
    """
    launch_split(
        _gather_kernel,
        count,
        inputs=[indices, _words(source)],
        outputs=[_words(out)],
        device=device,
        min_piece=1024,
    )
