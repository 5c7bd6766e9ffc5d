# SPDX-License-Identifier: Apache-2.0
"""Tracking by G-ICP, and by colour where geometry leaves the pose uncertain."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.tracking.gicp import MAX_POSITION_STD, GicpConfig, GicpTracker
from ggwarp.pipeline.tracking.motion_model import depth_time, position_std
from ggwarp.pipeline.tracking.pose_refinement import RefinementConfig, Refiner
from ggwarp.pipeline.tracking.preprocess import SLIP
from ggwarp.runtime.state import Stateful
from ggwarp.solvers.alignment import Prior
from ggwarp.types import Float32, Float64, Frame, MapSnapshot, TrackResult, Verdict

_BASELINE = 4
"""Pixels between the readings that are compared: depth is quantised, and neighbours share their error."""
_ROWS = 8
"""Every eighth row of a depth image is looked at."""


_RENDERS = 2
"""Renders of an alignment at most."""

_CORRELATION = 0.3
"""How much larger the pose's deviation is than the 6x6 system says at the depth's own noise."""

_VELOCITY_DEVIATION = 0.1
"""Deviation of the velocity, metres and half radians a second: depth and colour are not taken at once."""

_MAX_POSITION_STD = 2e-4
"""Colour is asked where the position is more uncertain along some direction, metres."""

_MIN_NOISE = 0.05
"""Least noise that is assumed, as a share of the tracker's noise model."""


class HybridTracker(Stateful):
    """G-ICP whose pose becomes a prior of direct alignment where it is uncertain.

    How uncertain is said by the 6x6 system and by the noise of the depth image itself, measured in it: with
    clean depth and geometry on all sides colour has nothing to add; on a wall, or with a Kinect, it has.
    """

    STATE = ("_gicp", "_refiner")
    needs_gaussians = True

    def __init__(
        self,
        gicp: GicpConfig,
        refinement: RefinementConfig,
        sensor_camera: Camera,
        renderer: Renderer,
        *,
        device: Any = "cpu",
    ) -> None:
        """Make a tracker of frames with colour by ``renderer``'s camera and depth by ``sensor_camera``."""
        self._noise = gicp.noise_floor, gicp.noise_growth
        self._gicp = GicpTracker(gicp, sensor_camera, device=device)
        self._refiner = Refiner(refinement, renderer, renders=_RENDERS, device=device)

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the first frame, whose pose [4, 4] is given."""
        return self._gicp.start(frame, T_wc)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame.

        Raises:
            RuntimeError: there was no :meth:`start`.
        """
        result = self._gicp.track(frame, target)
        prior = self._prior(frame, result)
        sure = prior is not None and position_std(prior.information) <= _MAX_POSITION_STD
        if sure and result.verdict is not Verdict.LOST:
            return result
        # A lost frame's registration may have std anywhere that geometry allows.
        found = self._refiner.refine(frame, result.T_wc, prior=prior)
        if found.objection:
            return result
        lost = result.verdict is Verdict.LOST
        if lost or self._weak():
            self._gicp.correct(frame, found.T_wc)
        else:
            result = _with_points_kept(result, found.T_wc)
        return dataclasses.replace(
            result,
            T_wc=found.T_wc,
            verdict=Verdict.POOR if lost else result.verdict,
            reason=f"by colour alone: {result.reason}" if lost else result.reason,
            exposure=found.as_exposure(),
        )

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """The points that poses rest on stay where they are, whatever becomes of a keyframe's pose."""

    def on_map_moved(self, correction: PoseCorrection, index: int) -> None:
        """Follow the map, which a closed loop has moved; ``index``: of the last frame."""
        self._gicp.on_map_moved(correction, index)

    def _weak(self) -> bool:
        """Whether geometry alone leaves the position uncertain."""
        fit = self._gicp.registration
        return fit is None or position_std(fit.information) > MAX_POSITION_STD

    def _prior(self, frame: Frame, result: TrackResult) -> Prior | None:
        """Return what the last registration says of the colour's pose; None where there was none."""
        fit = self._gicp.registration
        if fit is None or not np.isfinite(fit.information).all():
            return None
        image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
        assert image is not None, "it was registered"
        noise = max(relative_noise(image, *self._noise), _MIN_NOISE)
        assert result.points is not None, "they were registered"
        information = without_slip(fit.information, result.points.points, SLIP)
        information /= (noise * _CORRELATION) ** 2
        gap = abs(frame.timestamp - depth_time(frame))
        information = loosened(information, _VELOCITY_DEVIATION * gap)
        return Prior(se3.inverse(fit.T_wc @ self._gicp.to_colour(frame)), information)


def _with_points_kept(result: TrackResult, T_wc: Float64) -> TrackResult:
    """Return ``result`` with its points in the camera at ``T_wc`` [4, 4], where they are in the world.

    Points are registered to points: depth agrees with depth, whatever colour makes of the camera's pose. On
    TUM fr1/xyz the trajectory's error is 0.6 cm so, and 0.9 cm with points that follow the colour's pose.
    """
    assert result.points is not None
    T = se3.inverse(T_wc) @ result.T_wc
    points = dataclasses.replace(
        result.points,
        points=se3.transform_points(T, result.points.points).astype(np.float32),
        quats=se3.rotate_quats(T[:3, :3], result.points.quats).astype(np.float32),
    )
    return dataclasses.replace(result, points=points)


def without_slip(information: Float64, points: Float32, slip: float) -> Float64:
    """Return a registration's information [6, 6] without what its ellipses' extent along surfaces pretends.

    Patches slide on each other with a deviation of ``slip``; thousands of them would fix even a wall.

    Args:
        points: [n, 3] the registered ones, camera frame, metres.
        slip: metres, of a point and of its match.
    """
    x = points.astype(np.float64)
    cross = se3.hat(x.sum(axis=0))
    moments = x.T @ x
    pretended = np.block([[len(x) * np.eye(3), -cross], [cross, np.trace(moments) * np.eye(3) - moments]]) / (
        2.0 * slip**2
    )
    values, vectors = np.linalg.eigh(information - pretended)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def loosened(information: Float64, deviation: float) -> Float64:
    """Return the information [6, 6] on a pose after a random motion: metres, and twice as many radians."""
    if deviation <= 0.0:
        return information
    precision = np.diag([1.0] * 3 + [0.25] * 3) / deviation**2
    return precision - precision @ np.linalg.solve(information + precision, precision)


def relative_noise(image: Float32, floor: float, growth: float) -> float:
    """Return the noise of a depth image as a share of floor + growth z^2; 0 where too little is seen.

    Inverse depth is affine on a plane: what is left of its second difference along a row is noise. The median
    does not see edges. 0.00-0.06 for rendered depth, 0.5-0.8 for a Kinect's (floor 1 mm, growth 2 mm/m).

    Args:
        image: [h, w] metres, 0 = no reading.
        floor, growth: metres and 1/metre.
    """
    z = image[::_ROWS].astype(np.float64)
    inverse = np.divide(1.0, z, out=np.full(z.shape, np.nan), where=z > 0.0)
    left, middle, right = (
        inverse[:, : -2 * _BASELINE],
        inverse[:, _BASELINE:-_BASELINE],
        inverse[:, 2 * _BASELINE :],
    )
    bend = np.abs(left - 2.0 * middle + right)
    seen = np.isfinite(bend)
    if np.count_nonzero(seen) < 100:
        return 0.0
    depth = 1.0 / middle[seen]
    # A second difference has six times the variance of a reading; the median of |x| is 0.6745 deviations.
    deviation = bend[seen] * depth**2 / np.sqrt(6.0) / 0.6745
    return float(np.median(deviation / (floor + growth * depth**2)))
