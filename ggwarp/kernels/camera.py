# SPDX-License-Identifier: Apache-2.0
"""A pinhole camera on the device: what rasteriser, alignment and ray-caster are given."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class CameraIntrinsics:
    """A pinhole camera on the device, pixels; integer coordinates are pixel centres."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def intrinsics_of(camera: Any) -> CameraIntrinsics:
    """Return the device struct of ``camera`` (:class:`ggwarp.geometry.camera.Camera`)."""
    out = CameraIntrinsics()
    out.fx, out.fy, out.cx, out.cy = camera.fx, camera.fy, camera.cx, camera.cy
    out.width, out.height = camera.width, camera.height
    return out
