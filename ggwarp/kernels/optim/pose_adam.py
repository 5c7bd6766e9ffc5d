# SPDX-License-Identifier: Apache-2.0
"""Adam on a camera's pose, by the gradient of a left perturbation of world-to-camera."""

from typing import Any

import warp as wp

from ggwarp.kernels.math import vec6, vec6d
from ggwarp.kernels.optim.adam import step_of_six
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
    rates = vec6()
    for k in range(6):
        rates[k] = wp.where(k < 3, rate_translation, rate_rotation)
    step = step_of_six(g, rates, moments, steps)
    xi = vec6d()
    for k in range(6):
        xi[k] = -wp.float64(step[k])
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
