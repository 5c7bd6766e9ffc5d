# SPDX-License-Identifier: Apache-2.0
"""Adam on a camera's pose, by the gradient of a left perturbation of world-to-camera."""

from typing import Any

import warp as wp

from ggwarp.kernels.math import vec6, vec6d
from ggwarp.kernels.optim.adam import BETA1, BETA2, EPSILON, LOG_BETA1, LOG_BETA2
from ggwarp.kernels.rigid import orthonormalised, se3_exp

wp.set_module_options({"enable_backward": False})

_FINITE = wp.constant(wp.float32(1.0e30))


@wp.kernel
def _step_pose(
    gradient: wp.array[vec6],
    rate_translation: float,
    rate_rotation: float,
    moments: wp.array[vec6],
    steps: wp.array[wp.int32],
    T_cw: wp.array[wp.mat44],
):
    g = gradient[0]
    if not (wp.dot(g, g) < _FINITE):
        return
    step = steps[0] + 1
    steps[0] = step
    t = float(step)
    m = BETA1 * moments[0] + (1.0 - BETA1) * g
    v = BETA2 * moments[1] + (1.0 - BETA2) * wp.cw_mul(g, g)
    moments[0] = m
    moments[1] = v
    c1 = 1.0 / (1.0 - wp.exp(t * LOG_BETA1))
    c2 = 1.0 / wp.sqrt(1.0 - wp.exp(t * LOG_BETA2))
    xi = vec6d()
    for k in range(6):
        rate = wp.where(k < 3, rate_translation, rate_rotation)
        xi[k] = wp.float64(-rate * c1 * m[k] / (wp.sqrt(v[k]) * c2 + EPSILON))
    T_cw[0] = wp.mat44(orthonormalised(se3_exp(xi) * wp.mat44d(T_cw[0])))


def step_pose(
    gradient: Any, *, rates: tuple[float, float], moments: Any, steps: Any, T_cw: Any, device: Any
) -> None:
    """Take one Adam step T_cw <- Exp(-step) T_cw; one that is not finite is left out.

    Args:
        gradient: [1] vec6 (translation, rotation), of T_cw <- Exp(tau) T_cw.
        rates: metres and radians a step.
        moments: [2] vec6, first and second; zeros at first.
        steps: [1] int, steps taken.
        T_cw: [1] mat44, world to camera, updated.
    """
    wp.launch(_step_pose, dim=1, inputs=[gradient, *rates], outputs=[moments, steps, T_cw], device=device)
