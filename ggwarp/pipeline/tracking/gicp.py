# SPDX-License-Identifier: Apache-2.0
"""Tracking: the camera's pose by registering a frame's depth to the map's trackable points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.geometry.uncertainty import position_std
from ggwarp.pipeline.tracking.motion_model import MotionModel, depth_time
from ggwarp.pipeline.tracking.preprocess import Observation, ObservationConfig, observe
from ggwarp.pipeline.tracking.relocalisation import Relocaliser, ViewConsistency
from ggwarp.runtime.scratch import ScratchArrays
from ggwarp.runtime.state import Stateful
from ggwarp.runtime.streams import to_host
from ggwarp.solvers.registration import Registrar, Registration, RegistrationTarget, build_target
from ggwarp.solvers.registration_stages import REACH, cell_size, register_coarse_to_fine, scaled_information
from ggwarp.types import Float32, Float64, Frame, FramePoints, MapSnapshot, TrackResult, Verdict, overlap_of

OVERLAP_DISTANCE = 0.0316
"""A point within this distance of the map is matched, metres; at least ``REACH`` spacings."""

MAX_POSITION_STD = 0.01
"""A frame whose position is uncertain by more along some direction is poor, or lost if its overlap is poor
too, metres; thrice that where earlier views agree with it."""

_MIN_POINTS = 200
"""A frame with fewer points is lost."""

_FREE = 1.0
"""A position that is more uncertain may be anywhere, metres."""

_LOST_OVERLAP, _POOR_OVERLAP = 0.2, 0.4
"""A frame with a smaller share of points that lie on the map is lost, and poor."""

_MAX_JUMP, _MAX_TURN = 0.5, 0.6
"""A frame farther from its prediction is a jump, and poor at best, metres and radians."""

_SURE_OVERLAP = 0.6
"""Below this share, or after a jump, registration is tried from other poses, too, and the best pose that
remembered views agree with is taken; without such a pose the frame is lost."""

_CLEAR_OVERLAP = 0.9
"""That search ends where such a pose has this share."""


@dataclass(frozen=True)
class GicpConfig(ObservationConfig):
    """How a frame is registered."""


class GicpTracker(Stateful):
    """Frame-to-map generalised ICP (GG-SLAM section 1a).

    Keeps the last good pose and the velocity itself; never reads ``Frame.T_wc``;
    looks at colour only to find and check the pose of a frame that registers badly.

    Attributes:
        needs_gaussians: no: trackable points are enough.
        registration: of the last frame, whether it was accepted or not; None where there was none.
        information: [6, 6] of that registration, for what depth alone knows of the pose.
        predicted: [4, 4] the pose of the last frame's depth as its motion before let expect; None at first.
    """

    STATE = ("_registrar", "_relocaliser", "_motion", "_target_version", "_cell_size")
    needs_gaussians = False

    def __init__(self, config: GicpConfig, sensor_camera: Camera, *, device: Any = "cpu") -> None:
        """Make a tracker of frames whose sensor depth was taken by ``sensor_camera``."""
        self._config, self._camera, self._device = config, sensor_camera, device
        self._registrar = Registrar(device=device)
        self._relocaliser = Relocaliser(sensor_camera)
        self._target: RegistrationTarget | None = None
        self._target_version: int | None = None
        self._cell_size = 0.0
        self._motion: MotionModel | None = None
        self._before: MotionModel | None = None
        self._scratch = ScratchArrays(device)
        self._seen: Observation | None = None
        self.registration: Registration | None = None
        self.information: Float64 = np.zeros((6, 6))
        self.predicted: Float64 | None = None

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the first frame, whose pose [4, 4] is given; one with too few points is lost: start again."""
        seen = self._observe(frame)
        self._motion = MotionModel.at_rest(T_wc, depth_time(frame))
        if seen.count < _MIN_POINTS:
            return _result(T_wc, np.eye(4), seen, None, Verdict.LOST, self._too_few(seen))
        self.remember(frame, self._motion.T_wc)
        return _result(self._motion.T_wc, np.eye(4), seen, None)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame; RuntimeError: there was no :meth:`start`."""
        predicted = self.predicted = self.predict(frame)
        assert self._motion is not None
        seen = self._seen = self._observe(frame)
        self._before, self.registration, self.information = self._motion, None, np.zeros((6, 6))
        if seen.count < _MIN_POINTS:
            return self._lose(frame, predicted, seen, None, self._too_few(seen))
        self._aim(target, seen.spacing)
        found = self._search(frame, seen, predicted)
        verdict, reason = self._judge(found)
        if verdict is Verdict.LOST:
            return self._lose(frame, predicted, seen, found.distances2, reason)
        self._motion = self._motion.updated(found.fit.T_wc, depth_time(frame))
        self._relocaliser.remember(frame, found.fit.T_wc)
        return self._registered(frame, seen, found, verdict, reason)

    def predict(self, frame: Frame) -> Float64:
        """Return where the camera's motion lets expect it, [4, 4], when the depth of ``frame`` was taken."""
        if self._motion is None:
            raise RuntimeError("track() before start(): the first frame's pose must be given")
        return self._motion.predict(depth_time(frame))

    def track_again(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the last frame once more: ``frame`` has other readings now."""
        assert self._before is not None
        self._motion = self._before
        return self.track(frame, target)

    def register_again(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Register the last frame, ``frame``, once more, with its colour from about ``T_wc`` [4, 4].

        Sets ``registration`` and ``information``; :meth:`correct` makes the pose the last frame's.
        """
        assert self._seen is not None
        seen, T_dc = self._seen, self.to_colour(frame)
        found = self._verified(frame, self._fit(seen, T_wc @ se3.inverse(T_dc)))
        return self._registered(frame, seen, found, *self._judge(found))

    def _registered(
        self, frame: Frame, seen: Observation, found: _RegisteredPose, verdict: Verdict, reason: str
    ) -> TrackResult:
        T_dc = self.to_colour(frame)
        result = _result(found.fit.T_wc, T_dc, seen, found.distances2, verdict, reason)
        return replace(result, information=self.information)

    def _too_few(self, seen: Observation) -> str:
        return f"{seen.count} depth points, {_MIN_POINTS} needed"

    def place(self, frame: Frame, target: MapSnapshot, T_wc: Float64) -> TrackResult:
        """Take the pose [4, 4] as given; say only how the frame's points lie to the map there."""
        seen = self._observe(frame)
        self._aim(target, seen.spacing)
        self._motion = MotionModel.at_rest(T_wc, depth_time(frame))
        return _result(T_wc, np.eye(4), seen, self._distances2(seen, T_wc))

    def correct(self, frame: Frame, T_wc: Float64) -> None:
        """Take ``T_wc`` [4, 4] as the pose of the last frame's colour: somebody knows better."""
        assert self._motion is not None and self._before is not None
        T_wd = T_wc @ se3.inverse(self._motion.to_colour(frame))
        self._motion = self._before.updated(T_wd, depth_time(frame))

    def remember(self, frame: Frame, T_wc: Float64) -> None:
        """Know the view of ``frame`` from ``T_wc`` [4, 4], to find and check poses by."""
        self._relocaliser.remember(frame, T_wc)

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """The points that poses rest on stay where they are, whatever becomes of a keyframe's pose."""

    def on_map_moved(self, correction: PoseCorrection, index: int) -> None:
        """Follow the map's points, which a closed loop has moved; ``index``: of the last frame."""
        self._relocaliser.move(correction)
        if self._motion is not None:
            self._motion.T_wc = se3.orthonormalised(correction.at([index])[0] @ self._motion.T_wc)

    def seconds_since_good(self, frame: Frame) -> float:
        """Return how long before the last frame, ``frame``, the last good one was."""
        assert self._before is not None
        return abs(depth_time(frame) - self._before.time)

    def to_colour(self, frame: Frame) -> Float64:
        """Return the motion [4, 4] from the camera of the last frame's depth to that of its colour."""
        assert self._motion is not None
        return self._motion.to_colour(frame)

    def _observe(self, frame: Frame) -> Observation:
        image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
        if image is None:
            raise ValueError(f"frame {frame.index} has no depth: GICP tracking needs it")
        more: dict[str, Any] = {"weights": frame.depth_weight, "scratch": self._scratch}
        return observe(image, self._camera, self._config, device=self._device, **more)

    def _aim(self, target: MapSnapshot, spacing: float) -> None:
        """Prepare the map for registration, unless it is the one already prepared."""
        if target.version != self._target_version:
            self._cell_size = cell_size(spacing)
            self._target_version, self._target = target.version, None
        if self._target is None:
            self._target = build_target(
                target.means, target.quats, target.scales, cell_size=self._cell_size, device=self._device
            )

    def _search(self, frame: Frame, seen: Observation, predicted: Float64) -> _RegisteredPose:
        """Register from the prediction; where that fits badly, from wherever the camera may have been."""
        assert self._motion is not None
        first = self._fit(seen, predicted)
        if first.overlap >= _SURE_OVERLAP and not first.jump:
            return first
        best = self._verified(frame, first)
        if best.certain:
            return best
        for T_start in self._relocaliser.candidate_poses(frame, [self._motion.T_wc, predicted]):
            found = self._verified(frame, self._fit(seen, T_start))
            if found.rank > best.rank:
                best = found
            if best.certain:
                break
        return best

    def _verified(self, frame: Frame, found: _RegisteredPose) -> _RegisteredPose:
        return replace(found, consistency=self._relocaliser.verify(frame, found.fit.T_wc))

    def _fit(self, seen: Observation, T_start: Float64) -> _RegisteredPose:
        assert self._target is not None
        fit = register_coarse_to_fine(self._registrar, seen.cloud, self._target, T_start, seen.spacing)
        assert self._motion is not None and self.predicted is not None
        jump = self._motion.jump(fit.T_wc, self.predicted, _MAX_JUMP, _MAX_TURN)
        return _RegisteredPose(fit, self._distances2(seen, fit.T_wc), jump)

    def _distances2(self, seen: Observation, T_wc: Float64) -> Float32:
        """Return [n] squared distance of each point to the map, m^2; inf where nothing is near.

        Near is within reach of the sampling, or within the sensor's own noise at that point.
        """
        assert self._target is not None
        reach = np.maximum(seen.noise, max(OVERLAP_DISTANCE, REACH * seen.spacing))
        farthest = float(reach.max(initial=0.0))
        distances2 = self._registrar.match_distances2(seen.cloud, self._target, T_wc, radius=farthest)
        return np.where(distances2 <= reach * reach, distances2, np.float32(np.inf))

    def _judge(self, found: _RegisteredPose) -> tuple[Verdict, str]:
        """Take note of a registration; return what it is worth, and why."""
        fit, overlap = found.fit, found.overlap
        self.registration, self.information = fit, scaled_information(fit)
        std = position_std(self.information)
        overlap_reason = f"overlap {overlap:.2f} with the map"
        std_reason = f"position free to slide by {std:.3f} m" if std < _FREE else "position free to slide"
        if overlap < _LOST_OVERLAP:
            return Verdict.LOST, overlap_reason
        if not np.isfinite(position_std(fit.information)):
            return Verdict.LOST, "the geometry does not fix the pose"
        if found.consistency is not None and not found.consistent:
            return Verdict.LOST, f"{overlap_reason}, {found.consistency} with earlier views"
        # One weakness alone can be the scene's; two together are a wrong pose.
        uncertain = std > MAX_POSITION_STD * (3.0 if found.consistent else 1.0)
        if uncertain and overlap < _POOR_OVERLAP:
            return Verdict.LOST, f"{std_reason}, {overlap_reason}"
        if std > MAX_POSITION_STD:
            return Verdict.POOR, std_reason
        if overlap < _POOR_OVERLAP:
            return Verdict.POOR, overlap_reason
        return (Verdict.POOR, found.jump) if found.jump else (Verdict.CONVERGED, "")

    def _lose(
        self, frame: Frame, predicted: Float64, seen: Observation, distances2: Float32 | None, reason: str
    ) -> TrackResult:
        assert self._motion is not None
        self._motion.lost += 1
        return _result(predicted, self._motion.to_colour(frame), seen, distances2, Verdict.LOST, reason)


@dataclass(frozen=True)
class _RegisteredPose:
    """A registration, its points' squared distances [n] to the map, how far it jumps, and what views say."""

    fit: Registration
    distances2: Float32
    jump: str
    consistency: ViewConsistency | None = None

    @property
    def overlap(self) -> float:
        return overlap_of(self.distances2)

    @property
    def consistent(self) -> bool:
        """Whether it was compared with remembered views, and they agree."""
        return self.consistency is not None and self.consistency.is_consistent

    @property
    def certain(self) -> bool:
        """Whether there is no need to look for a better one."""
        return self.consistent and self.overlap >= _CLEAR_OVERLAP

    @property
    def rank(self) -> tuple[bool, float]:
        """The larger, the better."""
        return self.consistent, self.overlap * (1.0 if self.consistency is None else self.consistency.score)


def _result(
    T_wd: Float64,
    T_dc: Float64,
    seen: Observation,
    distances2: Float32 | None,
    verdict: Verdict = Verdict.CONVERGED,
    reason: str = "",
) -> TrackResult:
    """Report the pose and the points as of the colour image.

    Args:
        T_wd: [4, 4] the pose when depth was taken. T_dc: [4, 4] the motion from then to the colour.
        distances2: [n] of the points to the map, m^2; None: they were not compared.
    """
    points, quats = seen.points, to_host(seen.quats).copy()
    if (T_dc != np.eye(4)).any():
        T_cd = se3.inverse(T_dc)
        points = se3.transform_points(T_cd, points).astype(np.float32)
        quats = se3.rotate_quats(T_cd[:3, :3], quats).astype(np.float32)
    points = FramePoints(
        points=points,
        quats=quats,
        spreads=to_host(seen.spreads).copy(),
        noise=seen.noise,
        distances2=np.full(seen.count, np.inf, np.float32) if distances2 is None else distances2,
        noise_share=seen.noise_share,
    )
    return TrackResult(T_wd @ T_dc, verdict, reason, points, overlap=points.overlap)
