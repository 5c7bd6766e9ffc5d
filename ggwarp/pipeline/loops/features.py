# SPDX-License-Identifier: Apache-2.0
"""A keyframe's visual features with depth, and which of two keyframes' features are the same.

SIFT (D. Lowe, IJCV 2004), as OpenCV computes it: it finds fewer features than ORB, but tells them apart from
other sides and distances, which is what counts where a place is seen again.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.runtime.state import state_value
from ggwarp.types import Float32, Float64, Frame

_WIDTH = 480
"""Wider pictures are brought to this width first, pixels: a larger one takes longer and finds the same."""

_MOST = 500
"""Features of a picture at most, the strongest."""

_CONTRAST = 0.01
"""Least contrast of a feature: a quarter of OpenCV's, as walls and ceilings have little."""

_RATIO = 0.8
"""A match is dropped where the second best is not farther than the best by this (Lowe section 7.1)."""

_PATCH = 1
"""A feature's depth is the median of so many pixels to each side."""

_EDGE = 0.03
"""A feature where these depths spread over more than this share of it is on an edge, and dropped."""


@state_value
@dataclass(frozen=True)
class Features:
    """Features of one picture, those with depth alone.

    Attributes:
        pixels: [n, 2] float64 (u, v), of the picture.
        points: [n, 3] float64 metres, camera frame.
        descriptors: [n, 128] uint8, RootSIFT times 512.
    """

    pixels: Float64
    points: Float64
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)


class FeatureExtractor:
    """Finds features in frames whose pictures ``camera`` takes and whose sensor depth ``sensor_camera``."""

    def __init__(self, camera: Camera, sensor_camera: Camera) -> None:
        self._camera, self._sensor_camera = camera, sensor_camera
        self._shrink = max(1.0, camera.width / _WIDTH)
        self._sift = cv2.SIFT.create(nfeatures=_MOST, contrastThreshold=_CONTRAST)

    def detect(self, rgb: NDArray[np.uint8]) -> tuple[Float64, NDArray[np.uint8]]:
        """Return the places [n, 2] (u, v) and descriptors [n, 128] of the features of ``rgb`` [h, w, 3]."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if self._shrink > 1.0:
            size = round(self._camera.width / self._shrink), round(self._camera.height / self._shrink)
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        keypoints, rows = self._sift.detectAndCompute(grey, None)
        if not keypoints:
            return np.zeros((0, 2)), np.zeros((0, 128), np.uint8)
        scale = np.array([rgb.shape[1] / grey.shape[1], rgb.shape[0] / grey.shape[0]])
        pixels = (np.array([k.pt for k in keypoints], np.float64) + 0.5) * scale - 0.5
        # RootSIFT (Arandjelovic and Zisserman, 2012): distances are then those of the histograms.
        rows = np.sqrt(rows / np.maximum(rows.sum(axis=1, keepdims=True), 1e-6))
        return pixels, np.rint(512.0 * rows).clip(0, 255).astype(np.uint8)

    def extract(self, frame: Frame) -> Features:
        """Return the features of ``frame``; none where it has no depth."""
        image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
        pixels, descriptors = self.detect(frame.rgb)
        if image is None or not len(pixels):
            return Features(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 128), np.uint8))
        depth = depth_at(image, pixels, frame.rgb.shape)
        there = depth > 0.0
        pixels = pixels[there]
        points = self._camera.back_project(pixels[:, 0], pixels[:, 1], depth[there])
        return Features(pixels, points, descriptors[there])


def depth_at(image: Float32, pixels: Float64, shape: tuple[int, ...]) -> Float64:
    """Return [n] the depth at ``pixels`` [n, 2] of a picture of ``shape``, metres; 0: none, or an edge."""
    scale = image.shape[1] / shape[1], image.shape[0] / shape[0]
    u = np.rint((pixels[:, 0] + 0.5) * scale[0] - 0.5).astype(int)
    v = np.rint((pixels[:, 1] + 0.5) * scale[1] - 0.5).astype(int)
    steps = np.arange(-_PATCH, _PATCH + 1)
    rows = (v[:, None, None] + steps[None, :, None]).clip(0, image.shape[0] - 1)
    columns = (u[:, None, None] + steps[None, None, :]).clip(0, image.shape[1] - 1)
    around = image[rows, columns].reshape(len(pixels), -1).astype(np.float64)
    around[around <= 0.0] = np.nan
    known = np.isfinite(around).sum(axis=1) >= (2 * _PATCH + 1)
    depth = np.zeros(len(pixels))
    if known.any():
        z = around[known]
        middle = np.nanmedian(z, axis=1)
        flat = np.nanmax(z, axis=1) - np.nanmin(z, axis=1) <= _EDGE * middle
        depth[known] = np.where(flat, middle, 0.0)
    return depth


def match_features(one: Features, other: Features) -> NDArray[np.intp]:
    """Return [m, 2] rows of ``one`` and ``other`` that look alike, each the other's best match."""
    return match_descriptors(one.descriptors, other.descriptors)


def match_descriptors(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Return [m, 2] rows of descriptors [n, 128] that are alike, each the other's best match."""
    if min(len(one), len(other)) < 2:
        return np.zeros((0, 2), np.intp)
    a, b = one.astype(np.float32), other.astype(np.float32)
    # All sums are of whole numbers below 2^24, which single precision holds exactly.
    distances2 = a @ (-2.0 * b.T)
    distances2 += (b * b).sum(axis=1)
    distances2 += (a * a).sum(axis=1)[:, None]
    rows = np.arange(len(a))
    forth, back = distances2.argmin(axis=1), distances2.argmin(axis=0)
    best = distances2[rows, forth]
    distances2[rows, forth] = np.inf
    good = (back[forth] == rows) & (best < _RATIO**2 * distances2.min(axis=1))
    return np.stack([rows[good], forth[good]], axis=1)
