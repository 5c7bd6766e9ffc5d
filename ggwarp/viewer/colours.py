# SPDX-License-Identifier: Apache-2.0
"""What colour each Gaussian has on the page: its own, or one that says something of it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.objects.linear_classifier import LinearClassifier
from ggwarp.results.renders import feature_basis
from ggwarp.types import Float32, Float64

COLOUR, DEPTH, OBJECTS, IDENTITY, UNCERTAINTY = "colour", "depth", "objects", "identity", "uncertainty"

_GOLDEN = 0.6180339887498949
_TINT = np.array([1.0, 0.55, 0.0], np.float32)
_TINT_SHARE = 0.45
_NO_OBJECT = 0.35  # grey


def modes(gaussians: Gaussians, classifier: LinearClassifier | None) -> list[str]:
    """Return the modes that a map can be shown in."""
    found = [COLOUR, DEPTH]
    if gaussians.object_ids is not None:
        found.append(OBJECTS)
    if gaussians.identities is not None:
        found.append(IDENTITY)
        if classifier is not None:
            found.append(UNCERTAINTY)
    return found


def splat_colours(
    gaussians: Gaussians, mode: str, *, eye: Float64, classifier: LinearClassifier | None = None
) -> Float32:
    """Return [n, 3] colours, 0..1.

    Args:
        mode: one of :func:`modes`. Depth is the distance from ``eye``, from the nearest twentieth (red) to
            the farthest (blue); identity the three principal components of the identities; uncertainty
            1 - p, p being the probability of the likeliest class, on a square-root scale: dark blue is
            certain.
        eye: [3] where the scene is looked at from, metres, world frame.
    """
    if mode == DEPTH:
        distances = np.linalg.norm(gaussians.means - eye.astype(np.float32), axis=1)
        near, far = np.percentile(distances, [5.0, 95.0]) if len(distances) else (0.0, 1.0)
        return _turbo(1.0 - (distances - near) / max(float(far - near), 1e-6))
    if mode == OBJECTS and gaussians.object_ids is not None:
        return palette(gaussians.object_ids)
    if mode == IDENTITY and gaussians.identities is not None and len(gaussians) > 1:
        mean, axes = feature_basis(gaussians.identities)
        return np.clip((gaussians.identities - mean) @ axes + np.float32(0.5), 0.0, 1.0).astype(np.float32)
    if mode == UNCERTAINTY and gaussians.identities is not None and classifier is not None:
        return _turbo(np.sqrt(1.0 - classifier.confidence(gaussians.identities)))
    return np.clip(np.float32(0.5) + np.float32(SH_C0) * gaussians.colours, 0.0, 1.0)


def palette(ids: NDArray[np.integer]) -> Float32:
    """Return [n, 3] colours, 0..1, of object ids [n]: neighbouring ids look different, 0 is grey."""
    hue = np.mod(ids * _GOLDEN, 1.0)
    saturation = np.where(ids % 2 == 0, 0.65, 0.95)
    value = np.where(ids % 3 == 0, 0.75, 0.95)
    hsv = np.stack([360.0 * hue, saturation, value], axis=-1).astype(np.float32)
    rgb = cv2.cvtColor(hsv.reshape(1, -1, 3), cv2.COLOR_HSV2RGB).reshape(-1, 3) if len(ids) else hsv
    return np.where((ids == 0)[:, None], np.float32(_NO_OBJECT), rgb).astype(np.float32)


def tinted(colours: Float32, chosen: NDArray[np.bool_]) -> Float32:
    """Return ``colours`` [n, 3] with the ``chosen`` [n] tinted as selected."""
    out = colours.copy()
    out[chosen] = (1.0 - _TINT_SHARE) * out[chosen] + _TINT_SHARE * _TINT
    return out


def _turbo(values: NDArray[np.floating]) -> Float32:
    levels = np.rint(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8).reshape(-1, 1)
    if not len(levels):
        return np.zeros((0, 3), np.float32)
    rgb = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), np.float32)[:, 0, ::-1]
    return np.asarray(rgb / 255.0, np.float32)
