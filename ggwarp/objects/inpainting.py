# SPDX-License-Identifier: Apache-2.0
"""Pictures made whole: what the filling of holes takes its colours from.

An inpainter is a function of a picture [h, w, 3] uint8 (RGB) and a mask [h, w] bool, True where the
picture is not known, that returns the picture with those pixels made up. Any other can be given instead.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float32

Bools = NDArray[np.bool_]
Picture = NDArray[np.uint8]
Inpaint = Callable[[Picture, Bools], Picture]

_REACH = 5.0  # pixels that OpenCV looks round an unknown one


def inpaint_opencv(rgb: Picture, mask: Bools) -> Picture:
    """Return ``rgb`` with the masked pixels filled by OpenCV's fast marching (Telea, 2004)."""
    filled = cv2.inpaint(np.ascontiguousarray(rgb), mask.astype(np.uint8), _REACH, cv2.INPAINT_TELEA)
    return np.asarray(filled, np.uint8)


def inpaint_shade(rgb: Picture, mask: Bools) -> Picture:
    """Return ``rgb`` with the masked pixels filled so that light and shade go on.

    The blurred picture is continued smoothly (biharmonic: value and slope go on across the outline, within
    the range of what is around), so that it stays dark behind the object that casts a shadow; what the
    blur took away is filled by OpenCV. Inside the holes of nine of the built-in office's objects this is
    1.5 dB nearer to the truth than OpenCV alone; behind the largest, a poster on bricks, 1.0 dB farther.
    """
    if mask.all() or not mask.any():
        return rgb
    from skimage.restoration import inpaint_biharmonic  # heavy, and seldom needed

    colour = rgb.astype(np.float32)
    low = _blurred(colour, ~mask)
    low = 255.0 * inpaint_biharmonic(low / 255.0, mask, channel_axis=2, split_into_regions=True)
    detail = np.clip(colour - low + 128.0, 0.0, 255.0).astype(np.uint8)
    filled = np.clip(low + inpaint_opencv(detail, mask) - 128.0, 0.0, 255.0)
    return np.where(mask[..., None], np.rint(filled), colour).astype(np.uint8)


def inpaint_depth(depth: Float32, mask: Bools) -> Float32:
    """Return ``depth`` [h, w] with the masked pixels filled smoothly, metres."""
    # Not Telea's method, whose form for floats goes astray in OpenCV 5.0.
    known = np.ascontiguousarray(np.where(mask, np.float32(0.0), depth), np.float32)
    return np.asarray(cv2.inpaint(known, mask.astype(np.uint8), _REACH, cv2.INPAINT_NS), np.float32)


def _blurred(colour: Float32, known: Bools) -> Float32:
    """Blur by a pixel, taking only ``known`` ones in."""
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), 1.0)
    total = cv2.GaussianBlur(np.where(known[..., None], colour, np.float32(0.0)), (0, 0), 1.0)
    return np.asarray(total / np.maximum(weight, 1e-4)[..., None], np.float32)
