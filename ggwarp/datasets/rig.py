# SPDX-License-Identifier: Apache-2.0
"""From the pictures that a recorder wrote to a frame: one pinhole camera, depth on the colour's pixels.

What differs from recorder to recorder, and is undone here: the lens's distortion (of the colour alone, or of
both pictures), depth of another size, depth by a camera of its own (other intrinsics; elsewhere, so that it
is to be registered), and intrinsics that change from frame to frame as a phone focuses.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.resize import enlarge_depth, reduce_depth, resize_nearest, sample_depth
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float32, Float64

_DENSITY = 1.5
"""Pixels of a picture to be registered for one of the colour's, along a side: fewer would leave pinholes,
as neighbours that are rounded to whole pixels lie up to 1 + 1/1.5 < 2 apart."""
_SAME_VIEW = 0.01
"""Two sizes show the same view when their aspects agree to this share: the rounding of a small picture."""


@dataclass(frozen=True)
class Lens:
    """A camera and how its lens bends the picture.

    Attributes:
        camera: the pinhole camera, at native size.
        distortion: OpenCV's coefficients (k1 k2 p1 p2 [k3 [k4 k5 k6]]); empty: none.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()


class Rig:
    """What makes frames of a recorder's pictures.

    Attributes:
        camera: of the frames: the colour lens's pinhole camera.
    """

    def __init__(
        self,
        colour: Lens,
        *,
        depth: Lens | None = None,
        T_colour_depth: Float64 | None = None,
        depth_distorted: bool = False,
    ) -> None:
        """Prepare the maps.

        Args:
            colour: the colour pictures' lens.
            depth: that of the depth pictures; None: they show what ``colour.camera`` does, at any size.
            T_colour_depth: [4, 4] takes points of the depth camera to the colour camera, metres; None: they
                are the same place. Needs ``depth``.
            depth_distorted: depth without a lens of its own is bent as the colour is.

        Raises:
            DatasetError: the distortion leaves nothing of the picture.
        """
        self.camera = colour.camera
        self._colour = colour
        self._depth = depth
        self._T = None if T_colour_depth is None else np.asarray(T_colour_depth, np.float64)
        self._depth_distorted = depth_distorted
        self._map = _Map.undistorting(colour, colour.camera) if colour.distortion else None

    def fits(self, width: int, height: int) -> bool:
        """Return whether depth pictures of this size can be brought to the frames."""
        if self._depth is not None:
            return (width, height) == (self._depth.camera.width, self._depth.camera.height)
        return abs(width * self.camera.height / (height * self.camera.width) - 1.0) <= _SAME_VIEW

    @property
    def wanted_depth(self) -> str:
        """What depth pictures must be, for messages."""
        if self._depth is not None:
            return f"the depth camera's are {self._depth.camera.width}x{self._depth.camera.height}"
        return (
            f"the colour is {self.camera.width}x{self.camera.height}; export the depth registered to the "
            "colour camera, or give its own camera in the camera file"
        )

    def bends(self, camera: Camera | None = None) -> bool:
        """Return whether colour pictures (of ``camera``, where it is not the recording's) are resampled."""
        return self._map is not None or camera not in (None, self.camera)

    def colour(self, rgb: NDArray[np.uint8], camera: Camera | None = None) -> NDArray[np.uint8]:
        """Return a colour picture [h, w, 3] as the frames' camera sees it.

        Args:
            camera: the one it was taken with, where that is not the recording's.
        """
        found = self._map_of(camera)
        return rgb if found is None else found.colour(rgb)

    def labels(
        self, mask: NDArray[np.int32] | None, camera: Camera | None = None
    ) -> NDArray[np.int32] | None:
        """Return labels drawn on a colour picture [h, w] as the frames' camera sees them; 0 outside."""
        found = self._map_of(camera)
        return mask if found is None or mask is None else found.nearest(mask)

    def depth(self, depth: Float32, camera: Camera | None = None) -> Float32:
        """Return a depth picture [h', w'] metres on the pixels of the frames [h, w]; 0 = no reading."""
        target = self.camera
        if self._depth is not None:
            depth = self._registered(depth)
        elif self._depth_distorted and self._map is not None:
            depth = self._map.depth(_fitted(depth, target))
        elif camera is not None and camera != target:
            source = camera.resized(depth.shape[1], depth.shape[0])
            depth = _Map.between(source, target).depth(depth)
        else:
            depth = _fitted(depth, target)
        if self._map is not None:  # no depth where the undistorted picture has no colour
            depth = np.where(self._map.seen, depth, np.float32(0.0))
        return depth

    def weights(self, weights: Float32, camera: Camera | None = None) -> Float32 | None:
        """Return weights of the readings of a depth picture [h', w'] on the pixels of the frames [h, w].

        None where depth is by a lens of its own: readings then move, each by its depth.
        """
        target = self.camera
        if self._depth is not None:
            return None
        if not self._depth_distorted and camera not in (None, target):
            source = camera.resized(weights.shape[1], weights.shape[0])
            return _Map.between(source, target).nearest(weights)
        weights = resize_nearest(weights, target.width, target.height)
        return self._map.nearest(weights) if self._depth_distorted and self._map is not None else weights

    def _map_of(self, camera: Camera | None) -> _Map | None:
        if camera is None or camera == self.camera:
            return self._map
        return _Map.undistorting(Lens(camera, self._colour.distortion), self.camera)

    def _registered(self, depth: Float32) -> Float32:
        if self._depth_map is not None:
            depth = self._depth_map.depth(depth)
        if self._T is None:
            return depth
        depth = register_depth(depth, self._ideal_depth, self._T, self._registered_camera)
        return _fitted(depth, self.camera)

    @cached_property
    def _registered_camera(self) -> Camera:
        """The colour camera, no finer than depth is."""
        assert self._depth is not None
        return self.camera.scaled(min(1.0, self._depth.camera.fx / self.camera.fx))

    @cached_property
    def _ideal_depth(self) -> Camera:
        """The pinhole camera of undistorted depth that is to be registered, dense enough for the colour."""
        assert self._depth is not None
        camera = self._depth.camera
        target = self._registered_camera
        wanted = _DENSITY * max(target.fx / camera.fx, target.fy / camera.fy)
        return camera.scaled(max(1.0, wanted))

    @cached_property
    def _depth_map(self) -> _Map | None:
        assert self._depth is not None
        target = self.camera if self._T is None else self._ideal_depth
        return None if self._depth == Lens(target) else _Map.undistorting(self._depth, target)


def typical_camera(cameras: Sequence[Camera]) -> Camera:
    """Return the camera of median focal lengths and centre of ``cameras`` of the most usual size."""
    size = Counter((c.width, c.height) for c in cameras).most_common(1)[0][0]
    values = [(c.fx, c.fy, c.cx, c.cy) for c in cameras if (c.width, c.height) == size]
    fx, fy, cx, cy = np.median(np.array(values), axis=0).tolist()
    return Camera(*size, fx, fy, cx, cy)


def _fitted(depth: Float32, camera: Camera) -> Float32:
    """Return depth of the view of ``camera`` at its size."""
    if depth.shape[0] >= camera.height and depth.shape[1] >= camera.width:
        return reduce_depth(depth, camera.width, camera.height)
    return enlarge_depth(depth, camera.width, camera.height)


class _Map:
    """Where each pixel of a picture to be made lies in the one that is there."""

    def __init__(self, u: Float32, v: Float32, width: int, height: int) -> None:
        """Take columns and rows [h, w] in a picture of ``width`` x ``height``."""
        self._u, self._v = u, v
        self.seen = (u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)
        """[h, w] where the picture to be made shows something at all."""

    @classmethod
    def undistorting(cls, lens: Lens, target: Camera) -> _Map:
        """Return the map from ``lens`` to the pinhole camera ``target`` at the same place."""
        if not lens.distortion:
            return cls.between(lens.camera, target)
        source, coefficients = lens.camera, np.array(lens.distortion)
        size = (target.width, target.height)
        u, v = cv2.initUndistortRectifyMap(
            source.matrix, coefficients, np.eye(3), target.matrix, size, cv2.CV_32FC1
        )
        found = cls(np.asarray(u, np.float32), np.asarray(v, np.float32), source.width, source.height)
        if not found.seen.any():
            shown = " ".join(f"{value:g}" for value in lens.distortion)
            raise DatasetError(f"distortion {shown}: leaves nothing of the picture; correct the camera file")
        return found

    @classmethod
    def between(cls, source: Camera, target: Camera) -> _Map:
        """Return the map from one pinhole camera to another at the same place."""
        u = (np.arange(target.width) - target.cx) / target.fx * source.fx + source.cx
        v = (np.arange(target.height) - target.cy) / target.fy * source.fy + source.cy
        u, v = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
        return cls(u, v, source.width, source.height)

    def colour(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.remap(rgb, self._u, self._v, cv2.INTER_LINEAR), np.uint8)

    def nearest(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return an image [h', w'] whose values are not mixed; 0 outside."""
        rows = np.rint(np.where(self.seen, self._v, 0.0)).astype(np.intp)
        columns = np.rint(np.where(self.seen, self._u, 0.0)).astype(np.intp)
        return np.where(self.seen, image[rows, columns], image.dtype.type(0))

    def depth(self, depth: Float32) -> Float32:
        return sample_depth(depth, self._u, self._v)


def register_depth(depth: Float32, source: Camera, T_target_source: Float64, target: Camera) -> Float32:
    """Return depth as a camera elsewhere would measure it: the nearest of the points that a pixel shows.

    Args:
        depth: [h, w] metres by ``source``, dense enough that ``target`` has no pixel between two of its own.
        T_target_source: [4, 4] takes points of the source camera to the target camera.

    Returns:
        [h', w'] metres by ``target``; 0 where no point falls.
    """
    rows, columns = np.nonzero(depth > 0.0)
    points = source.back_project(columns, rows, depth[rows, columns].astype(np.float64))
    points = points @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    at_rows, at_columns, inside = target.pixels_of(points)
    out = np.full((target.height, target.width), np.inf, np.float32)
    nearest = points[inside, 2].astype(np.float32)
    np.minimum.at(out.ravel(), at_rows[inside] * target.width + at_columns[inside], nearest)
    out[np.isinf(out)] = 0.0
    return out
