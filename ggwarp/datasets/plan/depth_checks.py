# SPDX-License-Identifier: Apache-2.0
"""Whether depth images can be what they are taken for: their unit, their values, what they measure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.types import Float32

MEDIANS = (0.2, 20.0)
"""Metres: median depth that indoor recordings have; beyond it, the unit is asked for."""
_NEVER = (0.02, 1000.0)
"""Metres: no camera's median depth."""
_FEW_VALUES = 24
"""Fewer values than that are no measurement of a room: metres cut to whole numbers."""
_FLAT = 0.003
"""Relative bend of inverse depth over a tenth of the width: a plane's is 0; along rays it is 0.01 to 0.05."""
_FEWEST_FLAT, _RATIO = 0.04, 1.3
"""Share of flat places, and how many times more of them there must be when readings are taken along rays.

In nine sequences (two Kinects, a RealSense, three renderers) there are at most 0.77 times as many; where
their depth is turned into distances along the rays, at least 1.4 times as many."""
_MOST_FLAT_SAMPLES = 20_000


class Fault(NamedTuple):
    """What is wrong with depth images.

    Attributes:
        reason: what is wrong, and what to do. certain: whether it cannot be right.
    """

    reason: str
    certain: bool


def depth_statistics(images: Sequence[Float32]) -> tuple[float | None, float | None]:
    """Return the median of all readings, metres, and the share of pixels with one; None without."""
    if not images:
        return None, None
    share = float(np.mean([np.count_nonzero(image) / image.size for image in images]))
    readings = np.concatenate([image[image > 0.0][:: max(1, image.size // 50_000)] for image in images])
    return (float(np.median(readings)) if len(readings) else None), share


def depth_faults(images: Sequence[Float32], camera: Camera, scale: float | None) -> Iterator[Fault]:
    """Yield what is wrong with depth ``images`` [h, w], metres, of several frames.

    Args:
        scale: what a metre counts in the files; None: they hold metres.
    """
    median, _ = depth_statistics(images)
    unit = "their values are taken for metres" if scale is None else f"{scale:g} is taken for a metre"
    if median is None:
        yield Fault("the depth images looked at hold no reading at all", False)
        return
    values = np.unique(np.concatenate([np.unique(image) for image in images]))
    values = values[values > 0.0]
    largest = float(values[-1])
    raw = largest * (scale or 1.0)
    if scale is not None and 1 < len(values) <= _FEW_VALUES and raw <= _FEW_VALUES:
        yield Fault(
            f"the depth images hold {len(values)} different values, the largest {raw:.0f} "
            f"({1e3 * largest:.3g} mm): are they metres cut to whole numbers? Export millimetres",
            True,
        )
        return
    if not _NEVER[0] <= median <= _NEVER[1]:
        yield Fault(
            f"the median depth is {median:.4g} m, as {unit}: no camera sees that; give the depth's scale "
            "in the camera file",
            True,
        )
    elif not MEDIANS[0] <= median <= MEDIANS[1]:
        yield Fault(
            f"the median depth is {median:.3g} m, as {unit}: is that right? The camera file's scale says it",
            False,
        )
    if scale is not None and _normalised(images, scale):
        yield Fault(
            "every depth image ends at the same largest value that its type holds: is each stretched to "
            "its own range? Export the depth itself",
            True,
        )
    if reason := _along_rays(images, camera):
        yield Fault(reason, False)


def _normalised(images: Sequence[Float32], scale: float) -> bool:
    """Return whether each image ends at what 8 or 16 bits hold, the values up to there being used."""
    ends = {round(float(image.max()) * scale) for image in images}
    if len(images) < 3 or len(ends) != 1 or ends.isdisjoint({255, 65534, 65535}):
        return False
    end = ends.pop()
    near = [np.unique(np.rint(image[image * scale > 0.95 * end] * scale)) for image in images]
    return all(len(values) >= 3 for values in near)


def _along_rays(images: Sequence[Float32], camera: Camera) -> str:
    """Say so where surfaces are flat only if depth is measured along the rays, not along the axis.

    On a plane, the inverse of z is linear in the pixel.
    """
    height, width = images[0].shape
    v, u = np.mgrid[:height, :width]
    rays = np.sqrt(1.0 + ((u - camera.cx) / camera.fx) ** 2 + ((v - camera.cy) / camera.fy) ** 2)
    as_z, as_rays, count = 0, 0, 0
    for image in images:
        if image.shape != (height, width):
            continue
        bends = _bends(image, width // 10), _bends((image / rays).astype(np.float32), width // 10)
        known = np.isfinite(bends[0])
        count += np.count_nonzero(known)
        as_z += np.count_nonzero(np.abs(bends[0][known]) < _FLAT)
        as_rays += np.count_nonzero(np.abs(bends[1][known]) < _FLAT)
    if count < _MOST_FLAT_SAMPLES or as_rays < _FEWEST_FLAT * count or as_rays < _RATIO * as_z:
        return ""
    return (
        "walls and floors are flat only if depth is the distance along each pixel's ray; it is read as the "
        "distance along the camera's axis: divide it by sqrt(1 + ((u - cx) / fx)^2 + ((v - cy) / fy)^2)"
    )


def _bends(depth: Float32, step: int) -> Float32:
    """Return relative second differences of inverse depth along rows and columns; not finite at holes."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(depth > 0.0, 1.0 / depth, np.nan)
        found = []
        for lines in (inverse[::3], inverse[:, ::3].T):
            if lines.shape[1] > 2 * step > 0:
                middle = lines[:, step:-step]
                found.append(((lines[:, : -2 * step] + lines[:, 2 * step :]) / (2.0 * middle) - 1.0).ravel())
    return np.concatenate(found).astype(np.float32) if found else np.zeros(0, np.float32)
