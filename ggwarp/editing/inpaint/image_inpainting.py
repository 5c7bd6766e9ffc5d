# SPDX-License-Identifier: Apache-2.0
"""Pictures made whole: what the filling of holes takes its colours from.

An inpainter is a function of a picture [h, w, 3] uint8 (RGB), of a mask [h, w] bool, True where the picture
is not known, and of those pixels of the mask [h, w] bool that are wanted. It returns the picture with these
made up; what it does about the rest of the mask does not matter. Any other can be given instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ggwarp.editing.inpaint.shade import NOTICED, most_gain
from ggwarp.types import Float32, Float64

Bools = NDArray[np.bool_]
Picture = NDArray[np.uint8]
Inpaint = Callable[[Picture, Bools, Bools], Picture]

CONTEXT = 15
"""Pixels: what is unknown and farther from what is wanted does not matter to it."""
_REACH = 5.0  # pixels that OpenCV looks round an unknown one
_LOW = 1.0  # pixels: what is blurred by so much goes on smoothly
_SHADE = 4.0  # pixels: what is coarser is light and shade, what is finer texture
_SLOPE = 2.0  # pixels over which the slope of what is known dies out
_BLACK = 8.0  # of 255: darker is as good as black
_LEAST_LIKE = 0.5  # correlation of a texture with itself, shifted
_LEAST_OVERLAP = 0.3  # of the known pixels, by which that is judged
_LEAST_SHIFT = 8.0  # pixels
_DAMPING = 0.02  # of slopes
_SHIFTS = 200  # tried, the likest first
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)  # a pixel and its neighbours


def inpaint_opencv(rgb: Picture, mask: Bools, wanted: Bools) -> Picture:
    """Return ``rgb`` with all masked pixels filled by OpenCV's fast marching (Telea, 2004)."""
    filled = cv2.inpaint(np.ascontiguousarray(rgb), mask.astype(np.uint8), _REACH, cv2.INPAINT_TELEA)
    return np.asarray(filled, np.uint8)


def inpaint_shade(rgb: Picture, mask: Bools, wanted: Bools) -> Picture:
    """Return ``rgb`` with the masked pixels near the ``wanted`` ones filled: light, shade and texture go on.

    Texture comes from where the picture, shifted, is most like itself (:func:`continued_texture`). What is
    left is continued smoothly (:func:`continued`).
    """
    if mask.all() or not wanted.any():
        return rgb
    colour = rgb.astype(np.float64)
    texture = continued_texture(colour - smoothed(colour, ~mask, _SHADE), mask)
    rest = np.clip(smoothed(colour - texture, ~mask, _LOW), 0.0, 255.0)
    open_ = _near(mask, wanted)
    filled = np.clip(continued(rest, ~mask, open_, slope=_SLOPE) + texture, 0.0, 255.0)
    return np.where(open_[..., None], np.rint(filled), colour).astype(np.uint8)


def relighting(rgb: Picture, known: Bools, lost: Float32) -> Float32:
    """Return [h, w] by how much ``rgb`` becomes brighter when what blocks its light goes, 1 or more.

    Light is continued from where less than :data:`NOTICED` of it is lost, without its slope, which
    is the shade's own.

    Args:
        known: [h, w] where ``rgb`` [h, w, 3] is known; elsewhere the result is 1.
        lost: [h, w] share of the light that is blocked, 0..1.
    """
    shaded = known & (lost > NOTICED)
    lit = known & ~shaded
    gain = np.ones(known.shape, np.float32)
    if not shaded.any() or not lit.any():
        return gain
    coarse, from_lit = (
        np.maximum(smoothed(rgb.astype(np.float64), where, _SHADE).mean(axis=2, keepdims=True), _BLACK)
        for where in (known, lit)
    )
    without = continued(from_lit, lit, _near(~lit, shaded), slope=_SLOPE)
    gain[shaded] = np.clip((without / coarse)[..., 0], 1.0, most_gain(lost))[shaded]
    return gain


def _near(mask: Bools, wanted: Bools) -> Bools:
    """Return which pixels of ``mask`` lie near to the ``wanted``.

    It is all of the mask where less would leave some without a known pixel beside them.
    """
    away = cv2.distanceTransform((~wanted).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    near = mask & (away <= CONTEXT)
    count, parts = cv2.connectedComponents(near.astype(np.uint8), connectivity=4)
    beside = near & cv2.dilate((~mask).astype(np.uint8), _CROSS).astype(bool)
    return near if len(np.unique(parts[beside])) == count - 1 else mask


def continued(picture: Float64, known: Bools, open_: Bools, *, slope: float) -> Float64:
    """Return ``picture`` [h, w, c] with the pixels of ``open_`` replaced by a spline under tension.

    Value and slope go on across the outline of the ``known``; over ``slope`` pixels the slope dies out, so
    that a wide hole is no darker in the middle than what is around. The sum of laplacian^2 +
    (gradient / slope)^2 is least, over pixels that are known or open. Each part of ``open_`` touches a known
    pixel.
    """
    from scipy.sparse import csr_matrix, diags, vstack  # heavy, and seldom needed
    from scipy.sparse.linalg import splu

    height, width = known.shape
    place = np.arange(known.size).reshape(height, width)
    pairs = np.concatenate(
        [
            np.stack([place[:, :-1].ravel(), place[:, 1:].ravel()], axis=1),
            np.stack([place[:-1].ravel(), place[1:].ravel()], axis=1),
        ]
    )
    around = cv2.dilate(open_.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) & known
    near = (open_ | around).ravel()
    pairs = pairs[near[pairs].all(axis=1)]
    count = len(pairs)
    rows = np.tile(np.arange(count), 2)
    signs = np.repeat([1.0, -1.0], count)
    gradient: Any = csr_matrix((signs, (rows, pairs.T.ravel())), shape=(count, near.size))
    # A pixel's laplacian counts where it, or a neighbour of it, is unknown.
    beside = cv2.dilate(open_.astype(np.uint8), _CROSS).ravel()
    laplacian: Any = diags(beside.astype(np.float64)) @ (gradient.T @ gradient)
    energy: Any = vstack([laplacian, gradient / slope]).tocsc()
    flat = picture.reshape(near.size, -1).copy()
    free, held = energy[:, open_.ravel()], energy[:, around.ravel()]
    # Symmetric and positive: ordered and factorised as such, it takes a fifth of the time.
    symmetric = {"SymmetricMode": True}
    normal = (free.T @ free).tocsc()
    solver = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    found = solver.solve(np.ascontiguousarray(-(free.T @ (held @ flat[around.ravel()]))))
    seen = flat[known.ravel()]
    flat[open_.ravel()] = np.clip(found, seen.min(axis=0), seen.max(axis=0))
    return flat.reshape(picture.shape)


def continued_texture(texture: Float64, mask: Bools) -> Float64:
    """Return ``texture`` [h, w, c] (mean 0) with each pixel, masked or not, predicted from one a shift away.

    The shifts are those under which the known part is most like itself; a pixel takes the best that leads
    to a known one, times their correlation, the factor of least error. Where nothing repeats it becomes 0.
    """
    height, width = mask.shape
    known = np.where(mask[..., None], 0.0, texture)
    likeness = _self_likeness(known, ~mask)
    best = np.argsort(likeness, axis=None)[::-1][:_SHIFTS]
    predicted, open_ = np.zeros_like(known), np.ones_like(mask)
    for row, column in zip(*np.unravel_index(best, likeness.shape), strict=True):
        like = float(likeness[row, column])
        if like < _LEAST_LIKE:
            break
        rows, columns = np.nonzero(open_)
        to_rows, to_columns = rows + row - (height - 1), columns + column - (width - 1)
        there = (to_rows >= 0) & (to_rows < height) & (to_columns >= 0) & (to_columns < width)
        there[there] = ~mask[to_rows[there], to_columns[there]]
        at = rows[there], columns[there]
        predicted[at] = like * known[to_rows[there], to_columns[there]]
        open_[at] = False
    return predicted


def _self_likeness(known: Float64, where: Bools) -> Float64:
    """Return [2 h - 1, 2 w - 1] the correlation of ``known`` with itself by shift, none in the middle.

    Shifts whose overlap is too small to judge by count as unlike, and so do those by a few pixels, under
    which any picture is like itself.
    """
    weight, power = where.astype(np.float64), (known**2).sum(axis=2)
    of_weight, of_power, of_known = _spectrum(weight), _spectrum(power), _spectrum(known)
    count = _correlation(of_weight, of_weight, where.shape)
    product = _correlation(of_known, of_known, where.shape)
    here = _correlation(of_power, of_weight, where.shape)
    there = _correlation(of_weight, of_power, where.shape)
    enough = count > _LEAST_OVERLAP * weight.sum()
    scale = np.sqrt(np.maximum(here * there, 0.0))
    rows, columns = np.indices(count.shape)
    enough &= np.hypot(rows - known.shape[0] + 1, columns - known.shape[1] + 1) > _LEAST_SHIFT
    enough &= scale > 1e-6 * max(float(power.sum()), 1e-6)
    return np.divide(product, scale, out=np.zeros_like(count), where=enough)


def _spectrum(image: Float64) -> NDArray[np.complex128]:
    """Return the Fourier transform of ``image`` [h, w] or [h, w, c] with room for every shift."""
    # Not scipy.signal, which takes seconds to import.
    height, width = (fft.next_fast_len(2 * n - 1, real=True) for n in image.shape[:2])
    return np.asarray(fft.rfft2(image, (height, width), axes=(0, 1)), np.complex128)


def _correlation(
    one: NDArray[np.complex128], other: NDArray[np.complex128], shape: tuple[int, ...]
) -> Float64:
    """Return [2 h - 1, 2 w - 1] the sums over the pixels p of one(p) other(p + shift), and over channels.

    ``one`` and ``other`` are spectra of images [h, w] of ``shape``; in the middle is no shift.
    """
    product = other * one.conj()
    if product.ndim == 3:
        product = product.sum(axis=2)
    height, width = shape
    size = tuple(fft.next_fast_len(2 * n - 1, real=True) for n in shape)
    cyclic = np.asarray(fft.irfft2(product, size), np.float64)
    return np.roll(cyclic, (height - 1, width - 1), (0, 1))[: 2 * height - 1, : 2 * width - 1]


def smoothed(colour: Float64, known: Bools, sigma: float) -> Float64:
    """Return ``colour`` [h, w, c] blurred by ``sigma`` pixels, taking only ``known`` ones in.

    A plane is fitted round each pixel, so that slopes stay what they are up to the outline of what is known.
    """

    def blurred(image: Float64) -> Float64:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), np.float64)

    rows, columns = (at / sigma for at in np.mgrid[: known.shape[0], : known.shape[1]])
    weight = known.astype(np.float64)
    basis = [np.ones_like(weight), rows, columns]
    moments = np.stack([np.stack([blurred(weight * a * b) for b in basis], -1) for a in basis], -2)
    values = np.stack([blurred((weight * a)[..., None] * colour) for a in basis], -2)
    # Moments about the pixel itself, at which the fit is evaluated.
    shift = np.zeros((*known.shape, 3, 3))
    shift[:] = np.eye(3)
    shift[..., 1, 0], shift[..., 2, 0] = -rows, -columns
    moments = shift @ moments @ np.swapaxes(shift, -1, -2)
    # Few pixels on one side tell no slope: a little damping makes it 0 there.
    damping = _DAMPING * moments[..., :1, :1] * np.diag([0.0, 1.0, 1.0]) + 1e-9 * np.eye(3)
    return np.asarray(np.linalg.solve(moments + damping, shift @ values)[..., 0, :], np.float64)


def inpaint_depth(depth: Float32, mask: Bools) -> Float32:
    """Return ``depth`` [h, w] with the masked pixels filled smoothly, metres."""
    # Not Telea's method, whose form for floats goes astray in OpenCV 5.0.
    known = np.ascontiguousarray(np.where(mask, np.float32(0.0), depth), np.float32)
    return np.asarray(cv2.inpaint(known, mask.astype(np.uint8), _REACH, cv2.INPAINT_NS), np.float32)
