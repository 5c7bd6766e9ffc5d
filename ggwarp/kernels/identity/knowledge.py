# SPDX-License-Identifier: Apache-2.0
"""What a map knows of the objects that a view shows, pixel by pixel, in one number each."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

NOTHING = wp.constant(-1)
"""The map shows another surface than the view's, or none."""
LEVEL_BITS = wp.constant(2)
"""A pixel's number is its class, shifted by these, and how sure that is: 0, 1: it is known, 2: certain."""


@wp.struct
class KnowledgeLimits:
    """What it takes to know.

    Attributes:
        tolerance: the map shows a surface where its depth is within this share of it...
        opacity: ... and it is more opaque than this.
        probability: of the class, where it is known.
        known, certain: votes behind it.
    """

    tolerance: wp.float32
    opacity: wp.float32
    probability: wp.float32
    known: wp.int32
    certain: wp.int32


@wp.kernel
def _knowledge_kernel(
    limits: KnowledgeLimits,
    depth: wp.array2d[wp.float32],
    median_depth: wp.array2d[wp.float32],
    transmittance: wp.array2d[wp.float32],
    classes: wp.array2d[wp.int32],
    probabilities: wp.array2d[wp.float32],
    votes: wp.array2d[wp.int32],
    out: wp.array2d[wp.int32],
):
    i, j = wp.tid()
    d = depth[i, j]
    number = NOTHING
    # Comparisons are false for NaN.
    shown = d > 0.0 and wp.abs(median_depth[i, j] - d) <= limits.tolerance * d
    if shown and 1.0 - transmittance[i, j] > limits.opacity and classes[i, j] >= 0:
        level = int(0)
        if probabilities[i, j] >= limits.probability:
            most = int(0)  # centres are sparser than pixels
            for row in range(wp.max(i - 1, 0), wp.min(i + 2, votes.shape[0])):
                for column in range(wp.max(j - 1, 0), wp.min(j + 2, votes.shape[1])):
                    most = wp.max(most, votes[row, column])
            level = wp.where(most >= limits.certain, 2, wp.where(most >= limits.known, 1, 0))
        number = (classes[i, j] << LEVEL_BITS) + level
    out[i, j] = number


def tell_knowledge(
    limits: KnowledgeLimits,
    *,
    depth: Any,
    median_depth: Any,
    transmittance: Any,
    classes: Any,
    probabilities: Any,
    votes: Any,
    out: Any,
    device: Any,
) -> None:
    """Write the number of each pixel: :data:`NOTHING`, or class and level by :data:`LEVEL_BITS`.

    Args:
        limits: what it takes to know.
        depth: [h, w] float, the view's, metres; 0 = none.
        median_depth, transmittance: [>= h, >= w] float, of the map's render.
        classes, probabilities: [h, w] int and float, the likeliest class there and how likely it is.
        votes: [h, w] int, the most that any Gaussian has whose centre is there.
        out: [h, w] int, written.
        device: a Warp device.
    """
    wp.launch(
        _knowledge_kernel,
        dim=out.shape,
        inputs=[limits, depth, median_depth, transmittance, classes, probabilities, votes],
        outputs=[out],
        device=device,
    )
