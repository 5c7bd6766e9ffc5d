# SPDX-License-Identifier: Apache-2.0
"""Adam on the Gaussians a view can see, and on the identity classifier.

A Gaussian's 14 geometry and colour parameters share one vec16 per moment, its identity another:
lanes 0-2 mean, 3-6 quaternion, 7-9 log scale, 10 opacity logit, 11-13 colour. Each Gaussian counts
its own steps: a Gaussian that appears late, or is seen seldom, then has its moments corrected for
*its* history, and its first step is as long as its learning rate, not 3.2 times that. Its rates can
fall with its steps, so that one fitted for long settles between views that disagree.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ggwarp.kernels.block import load4, load16, store4, store16
from ggwarp.kernels.math import vec6, vec16
from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})

BETA1 = wp.constant(wp.float32(0.9))
BETA2 = wp.constant(wp.float32(0.999))
LOG_BETA1 = wp.constant(wp.float32(math.log(0.9)))
LOG_BETA2 = wp.constant(wp.float32(math.log(0.999)))
EPSILON = wp.constant(wp.float32(1e-15))

OPACITY_LANE = wp.constant(10)

_FINITE = wp.constant(wp.float32(1.0e30))


@dataclass(frozen=True)
class AdamRates:
    """Learning rates per parameter (defaults: GS-ICP-SLAM and Gaussian Grouping).

    Attributes:
        means: metres a step.
        quats, log_scales, opacity, colours, identities: parameter units a step.
    """

    means: float = 4e-6
    quats: float = 1e-3
    log_scales: float = 5e-3
    opacity: float = 0.05
    colours: float = 2.5e-3
    identities: float = 2.5e-3

    def lanes(self) -> np.ndarray:
        """Return [2, 16] float32: the rates of the geometry lanes and of the identity lanes."""
        geometry = [self.means] * 3 + [self.quats] * 4 + [self.log_scales] * 3
        geometry += [self.opacity] + [self.colours] * 3 + [0.0] * 2
        return np.array([geometry, [self.identities] * 16], np.float32)


@dataclass(frozen=True)
class GaussianArrays:
    """Parameters of n Gaussians, or their gradients.

    Attributes:
        means: [n] vec3, metres.
        quats: [n] vec4, w first.
        log_scales: [n] vec3, log metres.
        opacity_logits: [n] float.
        colours: [n] vec3, SH coefficients of degree 0.
        identities: [n] vec16; None without identities.
    """

    means: Any
    quats: Any
    log_scales: Any
    opacity_logits: Any
    colours: Any
    identities: Any = None


@dataclass(frozen=True)
class AdamState:
    """Moments of n Gaussians; zeros at first.

    Attributes:
        first, second: [n] vec16, geometry lanes.
        first_identity, second_identity: [n] vec16; None without identities.
        steps: [n] int, steps each Gaussian has taken.
    """

    first: Any
    second: Any
    steps: Any
    first_identity: Any = None
    second_identity: Any = None


@wp.func
def step_of_six(g: vec6, rates: vec6, moments: wp.array[vec6], steps: wp.array[wp.int32]) -> vec6:
    """Count the step, update the two ``moments`` by the gradient, and return what is to be subtracted."""
    step = steps[0] + 1
    steps[0] = step
    t = float(step)
    m = BETA1 * moments[0] + (1.0 - BETA1) * g
    v = BETA2 * moments[1] + (1.0 - BETA2) * wp.cw_mul(g, g)
    moments[0] = m
    moments[1] = v
    c1 = 1.0 / (1.0 - wp.exp(t * LOG_BETA1))
    c2 = 1.0 / wp.sqrt(1.0 - wp.exp(t * LOG_BETA2))
    x = vec6()
    for k in range(6):
        x[k] = rates[k] * c1 * m[k] / (wp.sqrt(v[k]) * c2 + EPSILON)
    return x


@wp.func
def _step(m: vec16, v: vec16, rates: vec16, t: float) -> vec16:
    """Bias-corrected step lr m' / (sqrt(v') + eps)."""
    c1 = 1.0 / (1.0 - wp.exp(t * LOG_BETA1))
    c2 = 1.0 / wp.sqrt(1.0 - wp.exp(t * LOG_BETA2))
    root = vec16()
    for k in range(16):
        root[k] = wp.sqrt(v[k]) * c2 + EPSILON
    return wp.cw_div(wp.cw_mul(m, rates) * c1, root)


@wp.kernel
def _gaussians_kernel(
    offset: int,
    with_identity: int,
    slowing: float,
    ranks: wp.array[wp.int32],
    rates: wp.array[vec16],
    d_means: wp.array[wp.vec3],
    d_quats: wp.array[wp.vec4],
    d_log_scales: wp.array[wp.vec3],
    d_opacity_logits: wp.array[wp.float32],
    d_colours: wp.array[wp.vec3],
    d_identities: wp.array[vec16],
    first: wp.array[vec16],
    second: wp.array[vec16],
    first_identity: wp.array[vec16],
    second_identity: wp.array[vec16],
    steps: wp.array[wp.int32],
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[wp.float32],
    colours: wp.array[wp.vec3],
    identities: wp.array[vec16],
):
    # In index order: following the depth order costs four times as long on a CPU (cache misses).
    i = offset + wp.tid()
    if ranks[i] < 0:
        return
    dp = d_means[i]
    dq = load4(d_quats, i)
    ds = d_log_scales[i]
    dc = d_colours[i]
    g = vec16(
        dp[0], dp[1], dp[2], dq[0], dq[1], dq[2], dq[3], ds[0], ds[1], ds[2],
        d_opacity_logits[i], dc[0], dc[1], dc[2], 0.0, 0.0,
    )  # fmt: skip
    e = vec16()
    if with_identity != 0:
        e = load16(d_identities, i)
    # One bad number and the whole Gaussian keeps still; the comparison is false for NaN.
    if not (wp.dot(g, g) + wp.dot(e, e) < _FINITE):
        return
    step = steps[i] + 1
    steps[i] = step
    t = float(step)
    slower = 1.0 / wp.sqrt(1.0 + slowing * (t - 1.0))

    m = BETA1 * load16(first, i) + (1.0 - BETA1) * g
    v = BETA2 * load16(second, i) + (1.0 - BETA2) * wp.cw_mul(g, g)
    store16(first, i, m)
    store16(second, i, v)
    d = _step(m, v, rates[0] * slower, t)
    means[i] -= wp.vec3(d[0], d[1], d[2])
    store4(quats, i, wp.normalize(load4(quats, i) - wp.vec4(d[3], d[4], d[5], d[6])))
    log_scales[i] -= wp.vec3(d[7], d[8], d[9])
    opacity_logits[i] -= d[OPACITY_LANE]
    colours[i] -= wp.vec3(d[11], d[12], d[13])

    if with_identity != 0:
        m = BETA1 * load16(first_identity, i) + (1.0 - BETA1) * e
        v = BETA2 * load16(second_identity, i) + (1.0 - BETA2) * wp.cw_mul(e, e)
        store16(first_identity, i, m)
        store16(second_identity, i, v)
        store16(identities, i, load16(identities, i) - _step(m, v, rates[1], t))


@wp.kernel
def _hold_kernel(ranks: wp.array[wp.int32], free: wp.array[wp.int32], out: wp.array[wp.int32]):
    i = wp.tid()
    out[i] = wp.where(free[i] != 0, ranks[i], -1)


@wp.kernel
def _classifier_kernel(
    rate: wp.array[wp.float32],
    d_weights: wp.array[vec16],
    d_biases: wp.array[wp.float32],
    weight_moments: wp.array2d[vec16],
    bias_moments: wp.array2d[wp.float32],
    steps: wp.array[wp.int32],
    weights: wp.array[vec16],
    biases: wp.array[wp.float32],
):
    c = wp.tid()
    g = d_weights[c]
    gb = d_biases[c]
    if not (wp.dot(g, g) + gb * gb < _FINITE):
        return
    step = steps[c] + 1
    steps[c] = step
    m = BETA1 * weight_moments[0, c] + (1.0 - BETA1) * g
    v = BETA2 * weight_moments[1, c] + (1.0 - BETA2) * wp.cw_mul(g, g)
    weight_moments[0, c] = m
    weight_moments[1, c] = v
    mb = BETA1 * bias_moments[0, c] + (1.0 - BETA1) * gb
    vb = BETA2 * bias_moments[1, c] + (1.0 - BETA2) * gb * gb
    bias_moments[0, c] = mb
    bias_moments[1, c] = vb
    rates = vec16(rate[0])
    weights[c] -= _step(m, v, rates, float(step))
    biases[c] -= _step(vec16(mb), vec16(vb), rates, float(step))[0]


def adam_gaussians(
    parameters: GaussianArrays,
    gradients: GaussianArrays,
    state: AdamState,
    *,
    rates: Any,
    ranks: Any,
    device: Any,
    decay: float = 0.0,
) -> None:
    """Take one Adam step (eps 1e-15) for each visible Gaussian, in place; quaternions end unit.

    A Gaussian with a NaN, infinite or absurd (norm > 1e15) gradient keeps its parameters, moments and
    step count. Without identities in either ``parameters`` or ``gradients`` these are left alone.

    Args:
        parameters: [>= n] arrays, updated.
        gradients: [>= n] arrays, valid for visible Gaussians.
        state: [>= n] moments and step counts, updated.
        rates: [2] vec16, :meth:`AdamRates.lanes` on the device, so that a recorded graph sees changes.
        ranks: [n] int, negative where a Gaussian is not visible; see
            :attr:`ggwarp.kernels.raster.tiles.TileArrays.ranks`.
        device: a Warp device.
        decay: a Gaussian's rates fall by 1 / sqrt(1 + t / decay), t being its earlier steps; 0: they stay.
            Its identity's stay: they learn names, which views tell alike.
    """
    p, g, s = parameters, gradients, state
    with_identity = p.identities is not None and g.identities is not None
    identity_arrays = (g.identities, s.first_identity, s.second_identity, p.identities)
    d_identities, first_identity, second_identity, identities = (
        identity_arrays if with_identity else [None] * 4
    )
    launch_split(
        _gaussians_kernel,
        ranks.shape[0],
        inputs=[
            *(int(with_identity), 1.0 / decay if decay > 0.0 else 0.0, ranks, rates),
            *(g.means, g.quats, g.log_scales, g.opacity_logits, g.colours, d_identities),
        ],
        outputs=[
            *(s.first, s.second, first_identity, second_identity, s.steps),
            *(p.means, p.quats, p.log_scales, p.opacity_logits, p.colours, identities),
        ],
        device=device,
        min_piece=256,
    )


def hold_rows(ranks: Any, *, free: Any, out: Any, device: Any) -> None:
    """Have :func:`adam_gaussians` leave rows alone: write ``ranks`` with -1 for those that are not ``free``.

    Args:
        ranks, free, out: [n] int; free: 0 for a row that is held.
        device: a Warp device.
    """
    wp.launch(_hold_kernel, dim=ranks.shape[0], inputs=[ranks, free], outputs=[out], device=device)


def adam_classifier(
    weights: Any,
    biases: Any,
    *,
    d_weights: Any,
    d_biases: Any,
    weight_moments: Any,
    bias_moments: Any,
    steps: Any,
    rate: Any,
    classes: int,
    device: Any,
) -> None:
    """Take one Adam step for the first ``classes`` rows of the identity classifier, in place.

    Args:
        weights: [capacity] vec16; biases: [capacity] float.
        d_weights, d_biases: their gradients.
        weight_moments: [2, capacity] vec16; bias_moments: [2, capacity] float; zeros at first.
        steps: [capacity] int; each class counts its own, so that a new one starts afresh.
        rate: [1] float, the learning rate.
        classes: rows in use.
        device: a Warp device.
    """
    wp.launch(
        _classifier_kernel,
        dim=classes,
        inputs=[rate, d_weights, d_biases],
        outputs=[weight_moments, bias_moments, steps, weights, biases],
        device=device,
    )
