# SPDX-License-Identifier: Apache-2.0
"""Views of a map with and without an object, and the rays through their pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ggwarp.editing.map_view import MapView
from ggwarp.editing.progress import Progress, silent
from ggwarp.editing.windows import window_of
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
        left: [h, w] opacity of the map without the object, where the object is seen at all.
        left_depth: [h, w] of the surface of the map without the object, metres, there.
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


def view_object(whole: MapView, kept: MapView, T_wc: Float64, coverage: Float32) -> ObjectView:
    """Return what ``T_wc`` shows of ``whole``, and of ``kept``, the map without an object.

    Args:
        coverage: [h, w] the object's share of each pixel, 0..1.
    """
    touched = window_of(coverage > _TOUCHED, whole.camera)
    after, before = kept.render(T_wc, window=touched), whole.render(T_wc)
    return ObjectView(
        T_wc,
        rgb=before.rgb,
        depth=before.surface_depth,
        coverage=coverage,
        left=after.opacity,
        left_depth=after.surface_depth,
    )


def share_in_the_clear(
    whole: MapView,
    rest: MapView,
    poses: list[Float64],
    coverages: list[Float32],
    selected: Bools,
    *,
    progress: Progress = silent,
) -> tuple[Float32, Bools]:
    """Return how much of each Gaussian was ever seen apart from an object, and which the object hid.

    What was behind the object, or mixed with it at its outline, was never compared with a picture
    of itself: its colour and shape are left over from the fit to something else.

    Args:
        whole: the map, in which the object is ``selected`` [n]. rest: the map without it, m Gaussians.
        poses: views that show the object, [4, 4] camera-to-world each.
        coverages: [h, w] of each view: the object's share of each pixel, 0..1.

    Returns:
        [m] 0..1, the share in the best of the views that show it well, 0 for those that the object did not
        hide; [m] those that show where the object was.
    """
    touched = [coverage > _TOUCHED for coverage in coverages]
    behind = np.zeros(len(rest.gaussians), bool)
    for k, (T_wc, there) in enumerate(zip(poses, touched, strict=True)):
        progress("finding what it hid", 0.5 * k / len(poses))
        window = window_of(there, rest.camera)
        if window is not None:
            behind |= rest.weights(T_wc, there, window=window)[0] > 0.0
    share = np.zeros(len(behind), np.float32)
    clear, shown = [], []
    for k, (T_wc, there) in enumerate(zip(poses, touched, strict=True)):
        progress("finding what it hid", 0.5 + 0.5 * k / len(poses))
        window = rest.window_of(T_wc, behind)
        if window is not None:
            clear.append(whole.weights(T_wc, ~there, window=window)[0][~selected][behind])
            shown.append(rest.weights(T_wc, np.ones_like(there), window=window)[0][behind])
    if shown:
        total = np.stack(shown)
        well = total > _SHOWS * total.max(axis=0)
        shares = np.divide(np.stack(clear), total, out=np.zeros_like(total), where=well)
        share[behind] = shares.max(axis=0)
    return share, behind


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
