# SPDX-License-Identifier: Apache-2.0
"""The noise of a first-generation Kinect, as it was measured and published.

- Depth comes from disparity, which a correlation window of 9 x 9 pixels measures to an eighth of a pixel
  (Khoshelham and Elberink, Sensors 2012): a step of depth is 2.9 mm z^2.
- Along the line of sight the noise is 1.2 + 1.9 (z - 0.4)^2 mm, across it 0.8 pixels: where surfaces end,
  edges are ragged (Nguyen, Izadi and Lovell, 3DIMPVT 2012). Neighbours within a window err alike.
- The sum is rounded in disparity (Barron and Malik, CVPR 2013, who add both kinds of noise before rounding).
- The camera's calibration leaves an offset of the disparity that differs over the image and stays
  (Herrera C., Kannala and Heikkilä, PAMI 2012; Teichman, Miller and Thrun, RSS 2013): a correlated error of
  depth that grows with z^2. Corrected as well as can be it is about the resolution (Clarkson et al., 2013:
  3 mm): a smooth field with the variance of the rounding.
- There is no depth in the projector's shadow, at grazing angles, nearer than 0.5 m or beyond 5 m.
"""

from __future__ import annotations

import cv2
import numpy as np

from ggwarp.datasets.built_in.faults import quantised_depth
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float32

KINECT_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
"""A Kinect's colour camera, to which its depth is registered."""

DISPARITY_STEP = 0.125
DISPARITY_CONSTANT = 43.5
"""Focal length of the infrared camera times the baseline of 7.5 cm, pixels metres."""
BIAS = DISPARITY_STEP / np.sqrt(12.0)
"""Standard deviation over the image of the disparity's lasting offset, pixels: as much as of its rounding."""
RANGE = 0.5, 5.0
"""Metres."""

_BASELINE = 0.075
_LATERAL = 0.8
_WINDOW = 9.0
_GRAZING = np.radians(10.0)
"""Between surface and line of sight."""
_EDGE = 0.05
"""Neighbours whose depths differ by this share of depth lie on different surfaces."""
_BIAS_WAVES = 3
"""The offset's field has this many nodes along the image's shorter side."""


def axial_sigma(depth: Float32) -> Float32:
    """Return the standard deviation of measured depth, metres, of surfaces ``depth`` metres away."""
    return (0.0012 + 0.0019 * (depth - 0.4) ** 2).astype(np.float32)


def disparity_offset(shape: tuple[int, int], seed: int) -> Float32:
    """Return the lasting offset of the disparity over an image of ``shape``, pixels; the same at any size."""
    rng = np.random.default_rng([seed, 6])
    nodes = rng.standard_normal((_BIAS_WAVES + 2, _BIAS_WAVES + 3)).astype(np.float32)
    field = cv2.resize(nodes, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return (field * np.float32(BIAS / field.std())).astype(np.float32)


def kinect_depth(depth: Float32, camera: Camera, index: int, seed: int) -> Float32:
    """Return true ``depth`` [h, w], metres, as a Kinect measures it in frame ``index``; 0 where it cannot.

    Args:
        depth: metres, 0 where nothing is.
        camera: of the image, at any size: what the model says in pixels is of 640 x 480 ones.
        index: the frame's index: noise is drawn anew in each.
        seed: of all randomness.
    """
    rng = np.random.default_rng([seed, 7, index])
    unit = camera.width / KINECT_CAMERA.width
    seen = _ragged(depth, _LATERAL * unit, rng)
    noise = _windowed(rng.standard_normal(depth.shape, np.float32), _WINDOW * unit / np.sqrt(12.0))
    # Rounding adds its own share to the published sum.
    rounding = DISPARITY_STEP / DISPARITY_CONSTANT / np.sqrt(12.0) * seen**2
    sigma = np.sqrt(np.maximum(axial_sigma(seen) ** 2 - rounding**2, 0.0))
    offset = disparity_offset((camera.height, camera.width), seed)
    disparity = np.divide(DISPARITY_CONSTANT, seen + sigma * noise, out=np.zeros_like(seen), where=seen > 0)
    noisy = np.divide(DISPARITY_CONSTANT, disparity + offset, out=np.zeros_like(seen), where=disparity > 0)
    out = quantised_depth(noisy.astype(np.float32), DISPARITY_STEP, DISPARITY_CONSTANT)
    lost = _shadow(depth, camera) | _grazing(depth, camera) | (out < RANGE[0]) | (out > RANGE[1])
    return np.where(lost, np.float32(0), out)


def _ragged(depth: Float32, sigma: float, rng: np.random.Generator) -> Float32:
    """Return depth whose edges stray by ``sigma`` pixels; within a surface it stays."""
    h, w = depth.shape
    v, u = np.mgrid[0:h, 0:w].astype(np.float32)
    shift = np.float32(sigma) * rng.standard_normal((2, h, w), np.float32)
    moved = cv2.remap(depth, u + shift[0], v + shift[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return np.where(np.abs(moved - depth) > _EDGE * depth, moved, depth).astype(np.float32)


def _windowed(white: Float32, sigma: float) -> Float32:
    """Return noise of standard deviation 1 that is alike within a window of ``sigma`` pixels."""
    kernel = cv2.getGaussianKernel(2 * int(np.ceil(3.0 * sigma)) + 1, max(sigma, 0.1), cv2.CV_32F)
    gain = float(np.sum(kernel**2))
    noise = cv2.sepFilter2D(white, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)
    return (noise / np.float32(gain)).astype(np.float32)


def _grazing(depth: Float32, camera: Camera) -> np.ndarray:
    """Return where a surface is seen at less than ten degrees; an edge is no surface."""
    slope = np.zeros_like(depth)
    for axis, focal in ((0, camera.fy), (1, camera.fx)):
        step = np.abs(np.diff(depth, axis=axis)) * np.float32(focal)
        ahead = np.pad(step, [(0, 1 - axis), (0, axis)], mode="edge")
        behind = np.pad(step, [(1 - axis, 0), (axis, 0)], mode="edge")
        slope = np.maximum(slope, np.minimum(ahead, behind))
    return slope > depth / np.tan(_GRAZING)


def _shadow(depth: Float32, camera: Camera) -> np.ndarray:
    """Return where the projector, beside the camera, is hidden by something nearer to its side."""
    column = np.arange(camera.width, dtype=np.float32)
    disparity = np.divide(_BASELINE * camera.fx, depth, out=np.zeros_like(depth), where=depth > 0)
    # In the projector's image a row of surfaces keeps its order, but for what is hidden.
    projected = column - disparity
    right = np.minimum.accumulate(projected[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(depth.shape, bool)
    hidden[:, :-1] = projected[:, :-1] > right[:, 1:] + 0.5
    return hidden
