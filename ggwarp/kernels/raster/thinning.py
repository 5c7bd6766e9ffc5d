# SPDX-License-Identifier: Apache-2.0
"""Every n-th pixel of a picture's planes, gathered on the device: what is counted over needs no more."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _thin_kernel(step: int, planes: wp.array3d[wp.float32], out: wp.array3d[wp.float32]):
    c, i, j = wp.tid()
    row, column = step / 2 + i * step, step / 2 + j * step
    value = float(0.0)
    if row < planes.shape[1] and column < planes.shape[2]:
        value = planes[c, row, column]
    out[c, i, j] = value


def thin_planes(planes: Any, *, step: int, out: Any, device: Any) -> None:
    """Write every ``step``-th pixel of each row and column, from the ``step // 2``-th on.

    Args:
        planes: [C, H, W] float.
        step: at least 1.
        out: [C, h, w] float, written; 0 beyond the planes.
        device: a Warp device.
    """
    wp.launch(_thin_kernel, dim=out.shape, inputs=[step, planes], outputs=[out], device=device)
