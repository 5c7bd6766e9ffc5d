# SPDX-License-Identifier: Apache-2.0
"""Pictures with depth, taken on the way, that later pictures are aligned to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.solvers.alignment import Aligner, Alignment, Reference
from ggwarp.solvers.pose_equations import Prior
from ggwarp.types import Exposure, Float32, Float64, Frame

_MAX_PIXELS = 80_000
"""Larger pictures are halved: a pose needs no more."""

_COARSE_PIXELS = 5_000
"""A quarter of the finest size's: a registration came before, whose pose coarser sizes mend at most."""

_COLOUR_NOISE = 0.1
"""Standard deviation of a colour, 0..1: far more than a camera's noise, for what depth's errors, reflections
and blur do to the residual."""

_AGREEMENT = 0.05
"""Depths of one surface differ by no more than this share, as far as sensors see: a pixel beside an edge, or
hidden now, would pull the camera to where it stood."""

_KEPT = 12
"""So many views are kept, the latest."""

_COMPARED = 2
"""A picture is aligned to so many views at most: the latest, and those that share most with it."""

_READINGS = 2000
"""About so many readings say what a view shares with a frame: the share's standard error is 1 % at most."""

_MIN_SHARED = 0.5
"""A view other than the latest is looked at where it shares at least so much."""

_NEW_VIEW = 0.8
"""A frame becomes a view where it sees less than this share of the latest one."""


@state_value
@dataclass(frozen=True)
class View:
    """A picture with depth.

    Attributes:
        frame: it, as it was taken.
        depth: [h, w] metres, 0 = none: its own, without what moves.
        T_wc: [4, 4] camera-to-world.
        exposure: (a, b): the picture is e^a x + b, x being as the first view has it.
    """

    frame: Frame
    depth: Float32
    T_wc: Float64
    exposure: tuple[float, float]


class ReferenceViews(Stateful):
    """The latest views, a sliding window, and the alignment of frames to them."""

    STATE = ("_views",)

    def __init__(self, camera: Camera, *, device: Any) -> None:
        """Keep nothing yet; frames' pictures are ``camera``'s."""
        self._camera = camera
        self._aligner = Aligner(
            camera,
            colour_noise=_COLOUR_NOISE,
            agreement=_AGREEMENT,
            max_pixels=_MAX_PIXELS,
            coarse_pixels=_COARSE_PIXELS,
            device=device,
        )
        self._views: list[View] = []
        self._references: dict[int, Reference] = {}
        self._points: dict[int, Float32] = {}

    def __len__(self) -> int:
        return len(self._views)

    def compared(self, frame: Frame, T_wc: Float64) -> list[View]:
        """Return the views to compare ``frame`` with if it was taken from about ``T_wc`` [4, 4]."""
        others = [(self.share_seen(view, frame, T_wc), view) for view in self._views[:-1]]
        others = [(share, view) for share, view in others if share >= _MIN_SHARED]
        others.sort(key=lambda pair: -pair[0])
        return [*self._views[-1:], *(view for _, view in others[: _COMPARED - 1])]

    def align(self, frame: Frame, T_wc: Float64, views: list[View], prior: Prior | None) -> Alignment:
        """Search the pose of ``frame`` near ``T_wc`` [4, 4] by ``views`` and ``prior``."""
        references = [self._reference(view) for view in views]
        self._aligner.take_picture(frame.rgb, frame.depth, compare_depth=False)
        return self._aligner.align(se3.inverse(T_wc), references=references, prior=prior)

    def share_compared(self, found: Alignment) -> float:
        """Return the largest share of the picture that was compared with one view."""
        camera = self._aligner.compared_camera
        return max(system.pixels for system in found.systems) / (camera.width * camera.height)

    def exposure(self, found: Alignment, views: list[View]) -> Exposure:
        """Return the exposure of an aligned picture, as the first view's is 0."""
        (a, b), (a_view, b_view) = found.exposure, views[0].exposure
        return Exposure.uniform(a + a_view, float(np.exp(a)) * b_view + b)

    def add_if_new(self, frame: Frame, still: Frame, T_wc: Float64, exposure: Exposure | None) -> None:
        """Take ``frame`` at ``T_wc`` [4, 4] as a view if it sees too little of the latest.

        Args:
            still: it, without the readings of what moves.
        """
        assert still.depth is not None, "tracked by depth"
        if self._views and self.share_seen(self._views[-1], still, T_wc) >= _NEW_VIEW:
            return
        a_b = (0.0, 0.0) if exposure is None else (exposure.log_gain[0], exposure.offset[0])
        self._views = [*self._views, View(frame, still.depth, np.array(T_wc), a_b)][-_KEPT:]
        kept = {view.frame.index for view in self._views}
        self._references = {index: made for index, made in self._references.items() if index in kept}
        self._points = {index: made for index, made in self._points.items() if index in kept}

    def move(self, correction: PoseCorrection) -> None:
        """Move the views with the map, which a closed loop has moved."""
        self._views = [
            replace(view, T_wc=se3.orthonormalised(correction.at([view.frame.index])[0] @ view.T_wc))
            for view in self._views
        ]
        self._references = {}

    def share_seen(self, view: View, frame: Frame, T_wc: Float64) -> float:
        """Return the share of the readings of ``view`` that ``frame`` at ``T_wc`` [4, 4] sees again."""
        assert frame.depth is not None, "tracked by depth"
        points = self._few_points(view)
        if not len(points):
            return 0.0
        x = se3.transform_points(se3.inverse(T_wc) @ view.T_wc, points)
        v, u, inside = self._camera.pixels_of(x)
        z, seen = x[inside, 2], frame.depth[v[inside], u[inside]]
        again = (seen > 0.0) & (np.abs(seen - z) <= _AGREEMENT * z)
        return float(np.count_nonzero(again) / len(points))

    def _reference(self, view: View) -> Reference:
        """Return what the aligner takes of a view."""
        made = self._references.get(view.frame.index)
        if made is None:
            made = self._references[view.frame.index] = self._aligner.reference(
                view.frame.rgb, view.depth, view.T_wc
            )
        return made

    def _few_points(self, view: View) -> Float32:
        """Return a few of a view's readings [n, 3], camera frame, metres."""
        points = self._points.get(view.frame.index)
        if points is None:
            depth = view.depth
            step = max(1, round((depth.size / _READINGS) ** 0.5))
            v, u = np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step]
            z = depth[v, u]
            points = self._camera.back_project(u, v, z)[z > 0.0].astype(np.float32)
            self._points[view.frame.index] = points
        return points
