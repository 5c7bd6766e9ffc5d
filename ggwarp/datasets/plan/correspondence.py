# SPDX-License-Identifier: Apache-2.0
"""Whether colour and depth, or masks, show the same: their edges lie on edges of the picture.

Agreement is how much stronger the picture's gradient is on the edges of the depth than where these are
displaced by some pixels, in standard deviations of the displaced ones. Of ten sequences (two Kinects, a
RealSense whose depth has too few edges, three renderers; means of six frames) the least is 3.2; with the
depth of other frames it reaches 1.4, with depth scaled by 0.92 it is 0.6 to 2.1. Depth of a neighbouring
frame agrees less in all of them. Borders of masks: Replica's office0 6.8, the built-in office 8.4, the
apartment 2.8 to 4.8; with masks of frames farther than a few away or mirrored, at most 1.1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.types import Float32

_WIDTH = 320
"""Pixels that pictures are reduced to: edges of sensors' depth lie a pixel or two off at 640."""
_STEP = 0.04
"""An edge of depth: neighbours that differ by more of the nearer one; three times a Kinect's noise at 8 m."""
_FEWEST = 150
"""Pixels on edges that say something."""
_FEWEST_FRAMES = 4
"""Frames that say something together."""
_DISPLACEMENTS = tuple(
    (round(radius * np.sin(angle)), round(radius * np.cos(angle)))
    for angle in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    for radius in (12, 20)
)
"""(rows, columns) that edges are moved by: beyond what a picture's own edges are wide."""
_OFFSETS = (-3, -2, -1, 1, 2, 3)
"""Frames by which the depth may be late or early."""
_BETTER = 0.03
"""In ranks of gradients: how much better another frame's depth must fit; in those sequences it never does."""
LEAST_AGREEMENT = 1.5
"""Below it, colour and depth do not show the same."""


def neighbours(indices: Iterable[int], count: int) -> list[int]:
    """Return ``indices`` and the frames, of ``count``, whose depth :func:`judge` also compares, rising."""
    around = {index + offset for index in indices for offset in (0, *_OFFSETS)}
    return sorted(index for index in around if 0 <= index < count)


def judge(
    pictures: Mapping[int, NDArray[np.uint8]], edges: Mapping[int, NDArray[np.bool_]], what: str = "depth"
) -> str:
    """Say what seems wrong with the pairing of a sequence's colour and depth, or masks; empty: nothing.

    Args:
        pictures: index -> the picture [h, w, 3] of the frames to look at.
        edges: index -> the edges of the depth of these and their :func:`neighbours`, where there are any; see
            :func:`edges_of_depth` and :func:`edges_of_labels`.
        what: "depth" or "mask".
    """
    agreements: list[float] = []
    gains: dict[int, list[float]] = {offset: [] for offset in _OFFSETS}
    for index, rgb in pictures.items():
        here = edges.get(index)
        if here is None or here.sum() < _FEWEST:
            continue
        gradients = gradients_of_colour(rgb)
        if gradients.shape != here.shape:
            continue
        agreements.append(agreement(gradients, here))
        own = float(gradients[here].mean())
        for offset in _OFFSETS:
            moved = edges.get(index + offset)
            if moved is not None and moved.shape == here.shape and moved.sum() >= _FEWEST:
                gains[offset].append(float(gradients[moved].mean()) - own)
    if len(agreements) < _FEWEST_FRAMES:
        return ""
    mean = float(np.mean(agreements))
    offset, gain = max(
        ((k, float(np.mean(v))) for k, v in gains.items() if len(v) >= _FEWEST_FRAMES),
        key=lambda item: item[1],
        default=(0, 0.0),
    )
    if gain > _BETTER:
        direction = "later" if offset > 0 else "earlier"
        return (
            f"the {what} of {abs(offset)} frame{'s' * (abs(offset) > 1)} {direction} fits the pictures "
            f"better than their own: are colour and {what} paired rightly, and numbered alike?"
        )
    if mean < LEAST_AGREEMENT:
        registered = ", and is depth registered to colour" if what == "depth" else ""
        return (
            f"edges of the {what} do not lie on edges of the pictures (agreement {mean:.1f}; 3 to 8 is "
            f"usual): do they belong together{registered}?"
        )
    return ""


def agreement(gradients: Float32, edges: NDArray[np.bool_]) -> float:
    """Return how well ``edges`` [h', w'] lie on ``gradients`` [h', w'], see the module."""
    moved = [float(gradients[np.roll(edges, by, (0, 1))].mean()) for by in _DISPLACEMENTS]
    return (float(gradients[edges].mean()) - float(np.mean(moved))) / max(float(np.std(moved)), 1e-6)


def edges_of_depth(depth: Float32) -> NDArray[np.bool_]:
    """Return [h', w'] where the surface ends in ``depth`` [h, w], metres: on the nearer side, no holes."""
    small = _reduced(depth, cv2.INTER_NEAREST)
    edges = np.zeros(small.shape, np.bool_)
    for axis in (0, 1):
        a, b = (small[:-1], small[1:]) if axis == 0 else (small[:, :-1], small[:, 1:])
        both = (a > 0.0) & (b > 0.0)
        jump = both & (np.abs(a - b) > _STEP * np.minimum(a, b))
        first, second = (edges[:-1], edges[1:]) if axis == 0 else (edges[:, :-1], edges[:, 1:])
        first |= jump & (a < b)
        second |= jump & (b <= a)
    return edges


def edges_of_labels(ids: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return [h', w'] where two ids of a mask [h, w] meet; a negative one meets nothing."""
    small = _reduced(ids, cv2.INTER_NEAREST)
    edges = np.zeros(small.shape, np.bool_)
    for a, b, first, second in (
        (small[:-1], small[1:], edges[:-1], edges[1:]),
        (small[:, :-1], small[:, 1:], edges[:, :-1], edges[:, 1:]),
    ):
        border = (a != b) & (a >= 0) & (b >= 0)
        first |= border
        second |= border
    return edges


def gradients_of_colour(rgb: NDArray[np.uint8]) -> Float32:
    """Return [h', w'] the rank, 0..1, of the picture's gradient at each pixel, whatever its exposure."""
    grey = np.asarray(cv2.cvtColor(_reduced(rgb, cv2.INTER_AREA), cv2.COLOR_RGB2GRAY), np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    size = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    # Within a pixel or two of an edge is on it.
    size = np.asarray(cv2.dilate(size, np.ones((3, 3), np.uint8)), np.float32)
    ranks = np.empty(size.size, np.float32)
    ranks[np.argsort(size, axis=None)] = np.linspace(0.0, 1.0, size.size, dtype=np.float32)
    return ranks.reshape(size.shape)


def _reduced(image: NDArray, interpolation: int) -> NDArray:
    height, width = image.shape[:2]
    if width <= _WIDTH:
        return image
    return cv2.resize(image, (_WIDTH, round(height * _WIDTH / width)), interpolation=interpolation)
