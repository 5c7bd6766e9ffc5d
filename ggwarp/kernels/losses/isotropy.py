# SPDX-License-Identifier: Apache-2.0
"""The pull towards round Gaussians (MonoGS eq. 10): weight sum_i mean_j |s_ij - mean_j s_ij|, in metres.

Without it Gaussians stretch along the view, where a few keyframes do not see it. The sum is over those in
view, so that the pull on each does not fade as the map grows.
"""

from typing import Any

import warp as wp

from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _isotropy_kernel(
    offset: int,
    weight: float,
    ranks: wp.array[wp.int32],
    log_scales: wp.array[wp.vec3],
    d_log_scales: wp.array[wp.vec3],
):
    i = offset + wp.tid()
    if ranks[i] < 0:
        return
    logs = log_scales[i]
    s = wp.vec3(wp.exp(logs[0]), wp.exp(logs[1]), wp.exp(logs[2]))
    deviation = s - wp.vec3((s[0] + s[1] + s[2]) / 3.0)
    signs = wp.vec3()
    for k in range(3):
        if deviation[k] > 0.0:
            signs[k] = 1.0
        if deviation[k] < 0.0:
            signs[k] = -1.0
    pull = signs - wp.vec3((signs[0] + signs[1] + signs[2]) / 3.0)
    d_log_scales[i] += weight / 3.0 * wp.cw_mul(pull, s)


def pull_round(log_scales: Any, *, ranks: Any, weight: float, d_log_scales: Any, device: Any) -> None:
    """Add the gradient of the isotropic term.

    Args:
        log_scales: [n] vec3. ranks: [n] int, negative: not in view.
        weight: a metre's worth of loss.
        d_log_scales: [n] vec3, added to.
    """
    launch_split(
        _isotropy_kernel,
        ranks.shape[0],
        inputs=[weight, ranks, log_scales],
        outputs=[d_log_scales],
        device=device,
    )
