# SPDX-License-Identifier: Apache-2.0
"""Neighbouring Gaussians should belong to the same object: KL term and its adjoint (GG-SLAM eqs. 9-10).

    L_obj3d = mean_{j,k} KL(P_j || Q_jk) / classes,  P, Q = softmax(W e + b)

over S sampled Gaussians j and the k nearest neighbours of each, as Gaussian Grouping computes it.
Each of the S (1 + k) *slots* (a sample, then its neighbours) gets its own gradient; slots of the
same Gaussian are then brought together by a stable sort and summed in order: deterministic.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.losses.rgbd import OBJECT_3D
from ggwarp.kernels.math import vec16
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

CHUNK = 256
"""Slots that one partial sum of the classifier's gradient covers."""

_NOBODY = wp.constant(2147483647)


@dataclass(frozen=True)
class NeighbourWorkspace:
    """Scratch of the KL term for S samples, k neighbours each, and up to ``capacity`` classes.

    Attributes:
        log_p: [slots, capacity] float, slots = S (1 + k); later the gradient by the logits.
        slot_gradients: [slots] vec16.
        keys, values: [2 slots] int, what :func:`warp.utils.radix_sort_pairs` needs.
        weight_partials: [ceil(slots / CHUNK), capacity] vec16; bias_partials: same, float.
        divergences: [S] float.
    """

    log_p: Any
    slot_gradients: Any
    keys: Any
    values: Any
    weight_partials: Any
    bias_partials: Any
    divergences: Any


@wp.func
def _gaussian_of(slot: int, count: int, samples: wp.array[wp.int32], neighbours: wp.array2d[wp.int32]) -> int:
    """Gaussian of a slot, -1 where either the sample or the neighbour is none."""
    width = neighbours.shape[1] + 1
    sample = slot / width
    place = slot - sample * width
    i = samples[sample]
    if i < 0 or i >= count:
        return -1
    if place > 0:
        i = neighbours[sample, place - 1]
        if i < 0 or i >= count:
            return -1
    return i


@wp.kernel
def _log_softmax_kernel(
    offset: int,
    classes: int,
    samples: wp.array[wp.int32],
    neighbours: wp.array2d[wp.int32],
    ranks: wp.array[wp.int32],
    identities: wp.array[vec16],
    weights: wp.array[vec16],
    biases: wp.array[wp.float32],
    log_p: wp.array2d[wp.float32],
    keys: wp.array[wp.int32],
    values: wp.array[wp.int32],
):
    slot = offset + wp.tid()
    i = _gaussian_of(slot, ranks.shape[0], samples, neighbours)
    values[slot] = slot
    if i < 0:
        keys[slot] = _NOBODY
        return
    keys[slot] = wp.where(ranks[i] >= 0, i, _NOBODY)
    e = identities[i]
    largest = float(-1.0e30)
    for c in range(classes):
        z = wp.dot(weights[c], e) + biases[c]
        log_p[slot, c] = z
        largest = wp.max(largest, z)
    total = float(0.0)
    for c in range(classes):
        total += wp.exp(log_p[slot, c] - largest)
    log_sum = largest + wp.log(total)
    for c in range(classes):
        log_p[slot, c] = log_p[slot, c] - log_sum


@wp.kernel
def _divergence_kernel(
    offset: int,
    classes: int,
    count: int,
    scale: float,
    samples: wp.array[wp.int32],
    neighbours: wp.array2d[wp.int32],
    log_p: wp.array2d[wp.float32],
    divergences: wp.array[wp.float32],
):
    """Sum a sample's divergences; turn the log probabilities of its slots into logit gradients."""
    sample = offset + wp.tid()
    k = neighbours.shape[1]
    first = sample * (k + 1)
    divergence = float(0.0)
    for c in range(classes):
        own = log_p[first, c]
        p = wp.exp(own)
        for slot in range(first + 1, first + 1 + k):
            if _gaussian_of(slot, count, samples, neighbours) >= 0:
                divergence += p * (own - log_p[slot, c])
    for c in range(classes):
        own = log_p[first, c]
        p = wp.exp(own)
        difference = float(0.0)
        for slot in range(first + 1, first + 1 + k):
            gradient = float(0.0)
            if _gaussian_of(slot, count, samples, neighbours) >= 0:
                difference += own - log_p[slot, c]
                gradient = scale * (wp.exp(log_p[slot, c]) - p)
            log_p[slot, c] = gradient
        own_gradient = scale * p * (difference - divergence)
        if _gaussian_of(first, count, samples, neighbours) < 0:
            own_gradient = 0.0
            divergence = 0.0
        log_p[first, c] = own_gradient
    divergences[sample] = divergence


@wp.kernel
def _slot_gradients_kernel(
    offset: int,
    classes: int,
    weights: wp.array[vec16],
    d_logits: wp.array2d[wp.float32],
    slot_gradients: wp.array[vec16],
):
    slot = offset + wp.tid()
    d = vec16()
    for c in range(classes):
        d += d_logits[slot, c] * weights[c]
    slot_gradients[slot] = d


@wp.kernel
def _classifier_kernel(
    offset: int,
    classes: int,
    slots: int,
    samples: wp.array[wp.int32],
    neighbours: wp.array2d[wp.int32],
    identities: wp.array[vec16],
    count: int,
    d_logits: wp.array2d[wp.float32],
    weight_partials: wp.array2d[vec16],
    bias_partials: wp.array2d[wp.float32],
):
    item = offset + wp.tid()
    chunk = item / classes
    c = item - chunk * classes
    d = vec16()
    db = float(0.0)
    for slot in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, slots)):
        i = _gaussian_of(slot, count, samples, neighbours)
        if i >= 0:
            g = d_logits[slot, c]
            d += g * identities[i]
            db += g
    weight_partials[chunk, c] = d
    bias_partials[chunk, c] = db


@wp.kernel
def _fold_kernel(
    chunks: int,
    loss_scale: float,
    weight_partials: wp.array2d[vec16],
    bias_partials: wp.array2d[wp.float32],
    divergences: wp.array[wp.float32],
    d_weights: wp.array[vec16],
    d_biases: wp.array[wp.float32],
    losses: wp.array[wp.float32],
):
    c = wp.tid()
    for chunk in range(chunks):
        d_weights[c] += weight_partials[chunk, c]
        d_biases[c] += bias_partials[chunk, c]
    if c == 0:
        total = float(0.0)
        for sample in range(divergences.shape[0]):
            total += divergences[sample]
        losses[OBJECT_3D] = total * loss_scale


@wp.kernel
def _gather_kernel(
    slots: int,
    keys: wp.array[wp.int32],
    values: wp.array[wp.int32],
    slot_gradients: wp.array[vec16],
    d_identities: wp.array[vec16],
):
    """The first of each run of equal keys adds up the run."""
    place = wp.tid()
    i = keys[place]
    if i == _NOBODY:
        return
    if place > 0:
        if keys[place - 1] == i:
            return
    d = d_identities[i]
    end = int(place)
    while end < slots and keys[end] == i:
        d += slot_gradients[values[end]]
        end += 1
    d_identities[i] = d


def neighbour_divergence(
    identities: Any,
    *,
    samples: Any,
    neighbours: Any,
    ranks: Any,
    weights: Any,
    biases: Any,
    classes: int,
    d_identities: Any,
    d_weights: Any,
    d_biases: Any,
    losses: Any,
    workspace: NeighbourWorkspace,
    weight: float = 1.0,
    device: Any,
) -> None:
    """Evaluate L_obj3d and *add* its gradient; positions, and so the neighbours, are constants.

    Args:
        identities: [>= n] vec16.
        samples: [S] int, sampled Gaussians; neighbours: [S, k] int; those outside [0, n) add nothing.
        ranks: [n] int; the identity gradient is added only where it is >= 0, that is where the view's
            adjoint has written ``d_identities`` (see :attr:`ggwarp.kernels.raster.tiles.TileArrays.ranks`).
        weights: [>= classes] vec16; biases: [>= classes] float.
        classes: classes in use, at most the workspace's capacity.
        d_identities: [>= n] vec16, added to.
        d_weights, d_biases: like ``weights`` and ``biases``, added to: call after the cross-entropy.
        losses: ``losses[OBJECT_3D]`` becomes the unweighted L_obj3d.
        workspace: scratch for this S and k.
        weight: l_obj3d.
        device: a Warp device.
    """
    sample_count, k = neighbours.shape
    if sample_count == 0 or k == 0:
        return
    slots, n = sample_count * (k + 1), ranks.shape[0]
    unit = 1.0 / (sample_count * k * classes)
    w = workspace
    launch_split(
        _log_softmax_kernel,
        slots,
        inputs=[classes, samples, neighbours, ranks, identities, weights, biases],
        outputs=[w.log_p, w.keys, w.values],
        device=device,
    )
    launch_split(
        _divergence_kernel,
        sample_count,
        inputs=[classes, n, weight * unit, samples, neighbours],
        outputs=[w.log_p, w.divergences],
        device=device,
    )
    launch_split(
        _slot_gradients_kernel,
        slots,
        inputs=[classes, weights, w.log_p],
        outputs=[w.slot_gradients],
        device=device,
    )
    chunks = -(-slots // CHUNK)
    launch_split(
        _classifier_kernel,
        chunks * classes,
        inputs=[classes, slots, samples, neighbours, identities, n, w.log_p],
        outputs=[w.weight_partials, w.bias_partials],
        device=device,
    )
    wp.launch(
        _fold_kernel,
        dim=classes,
        inputs=[chunks, unit, w.weight_partials, w.bias_partials, w.divergences],
        outputs=[d_weights, d_biases, losses],
        device=device,
    )
    wp.utils.radix_sort_pairs(w.keys, w.values, slots)
    wp.launch(
        _gather_kernel,
        dim=slots,
        inputs=[slots, w.keys, w.values, w.slot_gradients],
        outputs=[d_identities],
        device=device,
    )
