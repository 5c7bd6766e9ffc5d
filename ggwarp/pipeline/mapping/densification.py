# SPDX-License-Identifier: Apache-2.0
"""Densification by gradients and the opacity reset, as in 3-D Gaussian Splatting and MonoGS.

A Gaussian whose projected mean keeps a large gradient covers what one Gaussian cannot show: it is doubled
where it is small, and split in two where it is large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.kernels.optim.adam import OPACITY_LANE
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import join
from ggwarp.runtime.streams import to_host

_OFFSET = 50
"""Iterations before Gaussians are first densified."""
_SPLIT_SCALE = 0.03
"""Gaussians with a larger standard deviation are split, metres; smaller ones are doubled."""
_SHRINK = 1.6
"""The parts of a split Gaussian are smaller by this factor."""
RESET_OPACITY = 0.4
"""What a reset lowers opacities to, where they are higher."""


@dataclass(frozen=True)
class DensifyConfig:
    """When Gaussians are densified, and when opacities begin anew."""

    interval: int = 0
    """Gaussians are densified every that many iterations (MonoGS: 150). With 0 seeding alone adds any."""
    threshold: float = 2e-4
    """A Gaussian is densified when its projected mean has a larger gradient than this, in the mean over the
    iterations that showed it. The image is 2 wide and 2 high."""
    reset_interval: int = 0
    """Opacities of Gaussians that the window does not see are lowered every that many iterations (MonoGS:
    2001). With 0 they never are."""


def densify_is_due(config: DensifyConfig, iteration: int) -> bool:
    """Whether Gaussians are densified after ``iteration``."""
    since = iteration - _OFFSET
    return config.interval > 0 and since > 0 and since % config.interval == 0


def densify_gaussians(gaussians: GaussianMap, rng: np.random.Generator, *, threshold: float) -> int:
    """Double or split the Gaussians with the largest gradients; return how many they were.

    Gradients are counted anew from here.

    Args:
        gaussians: written; ``mean2d_gradient_norms`` and ``mean2d_gradient_counts`` hold those of each.
        rng: draws where the parts of a split Gaussian lie.
        threshold: see :class:`DensifyConfig`.
    """
    count, fields = gaussians.count, gaussians.fields
    mean2d_gradient_norms, counts = (
        to_host(fields[n])[:count] for n in ("mean2d_gradient_norms", "mean2d_gradient_counts")
    )
    dense = mean2d_gradient_norms > threshold * np.maximum(counts, 1)
    fields["mean2d_gradient_norms"].zero_()
    fields["mean2d_gradient_counts"].zero_()
    if not dense.any():
        return 0
    rows = gaussians.to_host()
    large = dense & (np.exp(rows.log_scales.max(axis=1)) > _SPLIT_SCALE)
    doubled = rows.take(dense & ~large)
    parts = rows.take(np.repeat(np.nonzero(large)[0], 2))
    offsets = np.exp(parts.log_scales) * rng.standard_normal(parts.means.shape)
    parts = replace(
        parts,
        means=(parts.means + _rotated(parts.quats, offsets)).astype(np.float32),
        log_scales=parts.log_scales - np.float32(math.log(_SHRINK)),
    )
    gaussians.append(join(doubled, parts))
    flags = np.ones(gaussians.count, np.int32)
    flags[:count] = ~large
    gaussians.keep(wp.array(flags, dtype=int, device=gaussians.device))
    return int(np.count_nonzero(dense))


def _rotated(quats: NDArray[np.float32], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``vectors`` [n, 3] rotated by the unit quaternions ``quats`` [n, 4], w first."""
    w, axis = quats[:, :1].astype(np.float64), quats[:, 1:].astype(np.float64)
    across = 2.0 * np.cross(axis, vectors)
    return vectors + w * across + np.cross(axis, across)


def lower_opacities(gaussians: GaussianMap, seen: NDArray[np.bool_], opacity: float) -> None:
    """Lower the opacity of the Gaussians that are not ``seen`` [count] to ``opacity``, where it is higher.

    Those whose opacity changes forget its moments.
    """
    most = math.log(opacity / (1.0 - opacity))
    logits = to_host(gaussians.fields["opacity_logits"]).copy()
    changed = np.zeros(len(logits), bool)
    changed[: gaussians.count] = ~seen & (logits[: gaussians.count] > most)
    logits[changed] = most
    gaussians.fields["opacity_logits"].assign(logits)
    for name in ("first", "second"):
        array: Any = gaussians.fields[name]
        moments = to_host(array).copy()
        moments[changed, OPACITY_LANE] = 0.0
        array.assign(moments)
