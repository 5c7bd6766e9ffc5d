# SPDX-License-Identifier: Apache-2.0
"""Views of a map with and without an object, and the rays through their pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.editing.map_view import MapView
from ggwarp.editing.progress import Progress, silent
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float32, Float64

Bools = NDArray[np.bool_]

_TOUCHED = 0.1  # a smaller share of a pixel is not worth minding
_SHOWS = 0.25  # of a Gaussian's largest view: smaller ones say little of it


@dataclass(frozen=True)
class ObjectView:
    """What one view shows, with the object and how much of it.

    Attributes:
        T_wc: [4, 4] camera-to-world.
        rgb: [h, w, 3] colours, 0..1, the object in place.
        depth: [h, w] of the surface, metres, the object in place.
        coverage: [h, w] the object's share of each pixel, 0..1.
        left: [h, w] opacity of the map without the object.
        left_depth: [h, w] of the surface of the map without the object, metres.
    """

    T_wc: Float64
    rgb: Float32
    depth: Float32
    coverage: Float32
    left: Float32
    left_depth: Float32

    @property
    def blocked(self) -> Bools:
        """[h, w] where the object is what is seen."""
        return self.coverage > 0.5

    @property
    def touched(self) -> Bools:
        """[h, w] where the object is seen at all."""
        return self.coverage > _TOUCHED


def view_object(whole: MapView, kept: MapView, T_wc: Float64, selected: Bools) -> ObjectView:
    """Return what ``T_wc`` shows of ``whole``, and of ``kept``, the map without its ``selected`` [n]."""
    after, before = kept.render(T_wc), whole.render(T_wc)
    return ObjectView(
        T_wc,
        rgb=before.rgb,
        depth=before.surface_depth,
        coverage=whole.coverage(T_wc, selected)[0],
        left=after.opacity,
        left_depth=after.surface_depth,
    )


def share_in_the_clear(
    whole: MapView, rest: MapView, poses: list[Float64], selected: Bools, *, progress: Progress = silent
) -> tuple[Float32, Bools]:
    """Return how much of each Gaussian was ever seen apart from an object, and which the object hid.

    What was behind the object, or mixed with it at its outline, was never compared with a picture
    of itself: its colour and shape are left over from the fit to something else.

    Args:
        whole: the map, in which the object is ``selected`` [n]. rest: the map without it, m Gaussians.
        poses: views that show the object, [4, 4] camera-to-world each.

    Returns:
        [m] 0..1, the share in the best of the views that show it well; [m] those that show
        where the object was.
    """
    clear, shown, behind = [], [], []
    for k, T_wc in enumerate(poses):
        progress("finding what it hid", k / len(poses))
        touched = whole.coverage(T_wc, selected)[0] > _TOUCHED
        clear.append(whole.weights(T_wc, ~touched)[0][~selected])
        everywhere, there = rest.weights(T_wc, np.ones_like(touched), touched)
        shown.append(everywhere)
        behind.append(there)
    total = np.stack(shown)
    well = total > _SHOWS * total.max(axis=0)
    share = np.divide(np.stack(clear), total, out=np.zeros_like(total), where=well)
    return share.max(axis=0), np.stack(behind).max(axis=0) > 0.0


def world_rays(camera: Camera, T_wc: Float64, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Float64:
    """Return [n, 3] world directions of pixels, one unit deep in the camera frame."""
    return camera.rays(columns, rows) @ T_wc[:3, :3].T


def world_pixels(
    camera: Camera, T_wc: Float64, points: NDArray[np.floating]
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float64, Bools]:
    """Return the rows, columns and depths of ``points`` [n, 3], and which are inside the image."""
    local = se3.transform_points(se3.inverse(T_wc), points)
    rows, columns, inside = camera.pixels_of(local)
    return rows, columns, local[:, 2], inside
