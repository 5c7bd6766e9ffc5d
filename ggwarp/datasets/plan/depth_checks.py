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
"""Share of flat places, and how many times more of them there must be when depth is taken for something else.

In eleven sequences (two Kinects, a RealSense, three renderers) there are at most 0.77 times as many along
rays, and at most as many for disparity; where their depth is turned into distances along the rays, at least
1.4 times as many."""
_ROTATED = 0.98
"""Share of values that are multiples of 8 where the bits of millimetres are rotated by three (SUN RGB-D)."""
_HIGH = 0.1
"""Share of a type's range below which the median lies where single readings alone are far."""
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
    if scale is not None and len(values) > _FEW_VALUES and _rotated(values * scale) and scale < 8000.0:
        yield Fault(
            "the depth images' values are multiples of 8: are their bits rotated by three, as SUN RGB-D has "
            "them? (value >> 3) | (value << 13) turns them back",
            False,
        )
    if scale is not None and _normalised(images, scale):
        yield Fault(
            "every depth image ends at the same largest value that its type holds: is each stretched to "
            "its own range? Export the depth itself",
            True,
        )
    if reason := _not_along_the_axis(images, camera):
        yield Fault(reason, False)


def _rotated(raw: Float32) -> bool:
    """Return whether values of 16 bits hold nothing in the lowest three."""
    return float(np.mean(np.rint(raw).astype(np.int64) % 8 == 0)) > _ROTATED


def _normalised(images: Sequence[Float32], scale: float) -> bool:
    """Return whether each image ends at what 8 or 16 bits hold, as its scene would not by itself.

    Stereo cameras have single readings up there, too; but where the range is stretched, the median is high.
    """
    if len(images) < 3 or not all(image.any() for image in images):
        return False
    ends = [float(image.max()) * scale for image in images]
    medians = [float(np.median(image[image > 0.0])) * scale for image in images]
    for full in (255.0, 65535.0):
        if all(0.98 * full <= end < full + 0.5 for end in ends) and min(medians) > _HIGH * full:
            return True
    return False


def _not_along_the_axis(images: Sequence[Float32], camera: Camera) -> str:
    """Say so where surfaces are flat only if depth is something else than the distance along the axis.

    On a plane, the inverse of z is linear in the pixel.
    """
    height, width = images[0].shape
    v, u = np.mgrid[:height, :width]
    rays = np.sqrt(1.0 + ((u - camera.cx) / camera.fx) ** 2 + ((v - camera.cy) / camera.fy) ** 2)
    flat, count = np.zeros(3), 0
    for image in images:
        if image.shape != (height, width):
            continue
        inverse = np.divide(1.0, image, out=np.zeros_like(image), where=image > 0.0)
        bends = [_bends(depth, width // 10) for depth in (image, (image / rays).astype(np.float32), inverse)]
        known = np.isfinite(bends[0])
        count += np.count_nonzero(known)
        flat += [np.count_nonzero(np.abs(bend[known]) < _FLAT) for bend in bends]
    as_z, as_rays, as_disparity = flat
    best = max(as_rays, as_disparity)
    if count < _MOST_FLAT_SAMPLES or best < _FEWEST_FLAT * count or best < _RATIO * as_z:
        return ""
    if as_disparity > as_rays:
        return (
            "walls and floors are flat only if the depth images hold disparity, or inverse depth; they are "
            "read as distance: export depth"
        )
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
