# SPDX-License-Identifier: Apache-2.0
"""Keyframes as mapping sees them: arrays on the device."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.kernels.math import vec6
from ggwarp.runtime.streams import to_host
from ggwarp.types import Exposure, Float64, Frame

_NEUTRAL = Exposure()


@dataclass(frozen=True)
class Keyframe:
    """A frame the map is fitted to, on the device.

    Attributes:
        index: the frame's.
        has_depth: whether the frame came with depth.
        T_cw: [1] mat44, world to camera.
        pose_moments, pose_steps: [2] vec6 and [1] int, Adam's state of that pose.
        exposure: [1] vec6, see :mod:`ggwarp.kernels.photometric.affine_exposure`; 0: the map's own.
        exposure_moments, exposure_steps: as those of the pose.
        colour: [h, w, 3] uint8.
        depth: [h, w] float, metres, 0 = none.
        labels: [h, w] int class of each pixel; None where there is no mask.
    """

    index: int
    has_depth: bool
    T_cw: wp.array
    pose_moments: wp.array
    pose_steps: wp.array
    exposure: wp.array
    exposure_moments: wp.array
    exposure_steps: wp.array
    colour: wp.array
    depth: wp.array
    labels: wp.array | None


def upload(
    frame: Frame,
    T_wc: Float64,
    labels: NDArray[np.int32] | None,
    exposure: Exposure = _NEUTRAL,
    *,
    device: Any,
) -> Keyframe:
    """Copy ``frame``, seen from ``T_wc`` [4, 4], to the device.

    Args:
        labels: [h, w] class of each pixel; None where there is no mask.
        exposure: of the picture, where its fit starts.
    """
    T_cw = se3.inverse(T_wc).astype(np.float32)
    depth = np.zeros(frame.rgb.shape[:2], np.float32) if frame.depth is None else frame.depth
    row: Any = vec6
    return Keyframe(
        index=frame.index,
        has_depth=frame.depth is not None,
        T_cw=wp.array(T_cw[None], dtype=wp.mat44, device=device),
        pose_moments=wp.zeros(2, dtype=row, device=device),
        pose_steps=wp.zeros(1, dtype=wp.int32, device=device),
        exposure=wp.array([[*exposure.log_gain, *exposure.offset]], dtype=row, device=device),
        exposure_moments=wp.zeros(2, dtype=row, device=device),
        exposure_steps=wp.zeros(1, dtype=wp.int32, device=device),
        colour=wp.array(frame.rgb, dtype=wp.uint8, device=device),
        depth=wp.array(depth, dtype=float, device=device),
        labels=None if labels is None else wp.array(labels, dtype=int, device=device),
    )


class Keyframes(list[Keyframe]):
    """All keyframes, numbered in the order in which they came."""

    def pose(self, number: int) -> Float64:
        """Return the camera-to-world pose [4, 4] of keyframe ``number`` (-1: the newest) as it is now."""
        return se3.inverse(se3.orthonormalised(to_host(self[number].T_cw)[0].astype(np.float64)))

    def exposure(self, number: int) -> Exposure:
        """Return the exposure of keyframe ``number`` (-1: the newest) as it is now."""
        values = to_host(self[number].exposure)[0].tolist()
        return Exposure(tuple(values[:3]), tuple(values[3:]))


POSE = ("T_cw", "pose_moments", "pose_steps")
"""What a step of the pose changes."""
EXPOSURE = ("exposure", "exposure_moments", "exposure_steps")
"""What a step of the exposure changes."""


class KeyframeBuffer:
    """Holds one keyframe, always in the same arrays: recorded work reads it there."""

    def __init__(self) -> None:
        self._arrays: dict[str, Any] = {}

    def load(self, keyframe: Keyframe) -> Keyframe:
        """Return ``keyframe`` with its arrays copied here, on the device's current stream."""
        buffered: dict[str, Any] = {}
        for name in (f.name for f in fields(keyframe)):
            array = getattr(keyframe, name)
            if isinstance(array, wp.array):
                if name not in self._arrays:
                    self._arrays[name] = wp.empty_like(array)
                wp.copy(self._arrays[name], array)
                buffered[name] = self._arrays[name]
        return replace(keyframe, **buffered)

    def store(self, keyframe: Keyframe, names: tuple[str, ...]) -> None:
        """Copy the arrays ``names``, which the recorded work changed, back to ``keyframe``."""
        for name in names:
            wp.copy(getattr(keyframe, name), self._arrays[name])
