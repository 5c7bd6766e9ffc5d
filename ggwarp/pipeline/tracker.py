# SPDX-License-Identifier: Apache-2.0
"""Tracking: the camera's pose by registering a frame's depth to the map's trackable points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ggwarp import lie
from ggwarp.kernels.streams import to_host
from ggwarp.ops.registration import Registrar, Registration, Stage, Target, build_target, match_distances2
from ggwarp.pipeline.motion import Motion, depth_time, slide
from ggwarp.pipeline.observation import Observation, ObservationConfig, observe
from ggwarp.types import Camera, Float32, Float64, Frame, MapSnapshot, TrackResult, Verdict


@dataclass(frozen=True)
class TrackerConfig:
    """How a frame is registered, and when its pose is believed."""

    observation: ObservationConfig = field(default_factory=ObservationConfig)
    radii: tuple[float, ...] = (0.3, 0.1, 0.03)
    """Farthest match of each stage, coarse to fine, metres; at least ``reach`` spacings of points."""
    reach: float = 1.5
    """No search ends below so many spacings: between sparse points there is always a gap."""
    iterations: tuple[int, ...] = (6, 6, 15)
    """Linearisations of each stage at most."""
    coarse_thinning: int = 4
    """All stages but the last use every so-manyth point."""
    coarse_tolerance: float = 1e-3
    """A coarse stage ends when a step is smaller, metres and radians."""
    tolerance: float = 1e-4
    """The last stage ends when a step is smaller, metres and radians."""
    robust_scale: float = 3.0
    """Standard deviations at which Geman-McClure's kernel halves a residual's share of the cost in the
    last stage; wider in coarse stages, in the ratio of their radii."""
    overlap_distance: float = 0.0316
    """A point within this distance of the map is matched, metres; at least ``reach`` spacings."""
    min_points: int = 200
    """A frame with fewer points is lost."""
    lost_overlap: float = 0.2
    """A frame with a smaller share of matched points is lost."""
    poor_overlap: float = 0.4
    """A frame with a smaller share of matched points is poor."""
    sure_overlap: float = 0.6
    """Below this share, registration is tried from other poses too, and the best overlap taken."""
    search_turn: float = 0.15
    """Angle of those poses, up, down, left and right of the predicted and the last good one, radians;
    it grows with every lost frame."""
    max_slide: float = 0.01
    """A frame whose position is uncertain by more along some direction is poor, or lost if its overlap is
    poor too, metres."""
    max_jump: float = 0.5
    """A frame farther from its prediction is poor, or lost if its overlap is not sure, metres."""
    max_turn: float = 0.6
    """Likewise a frame turned farther, radians."""


class GicpTracker:
    """Frame-to-map generalised ICP (GG-SLAM section 1a).

    Keeps the last good pose and the velocity itself; reads neither ``Frame.T_wc`` nor colour.

    Attributes:
        registration: of the last frame, whether it was believed or not; None where there was none.
    """

    def __init__(self, config: TrackerConfig, sensor_camera: Camera, *, device: Any = "cpu") -> None:
        """Make a tracker of frames whose sensor depth was taken by ``sensor_camera``."""
        self._config = config
        self._camera = sensor_camera
        self._device = device
        self._registrar = Registrar(device=device)
        self._target: Target | None = None
        self._target_version: int | None = None
        self._motion: Motion | None = None
        self._before: Motion | None = None
        self.registration: Registration | None = None

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the first frame, whose pose [4, 4] is given; all its points are new to the map.

        A frame with too few points is lost: start again with the next one.
        """
        seen = self._observe(frame)
        self._motion = Motion.at_rest(T_wc, depth_time(frame))
        if seen.count < self._config.min_points:
            return _result(self._motion.T_wc, np.eye(4), Verdict.LOST, seen, self._too_few(seen))
        return _result(self._motion.T_wc, np.eye(4), Verdict.CONVERGED, seen)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame.

        Raises:
            RuntimeError: there was no :meth:`start`.
        """
        if self._motion is None:
            raise RuntimeError("track() before start(): the first frame's pose must be given")
        seen = self._observe(frame)
        self._before, self.registration = self._motion, None
        predicted = self._motion.predicted(depth_time(frame))
        if seen.count < self._config.min_points:
            return self._lose(frame, predicted, self._too_few(seen), seen)
        self._aim(target, seen.spacing)
        assert self._target is not None
        fit, distances2 = self._search(seen, predicted)
        self.registration = fit
        verdict, reason = self._judge(fit, predicted, _overlap(distances2))
        if verdict is Verdict.LOST:
            return self._lose(frame, predicted, reason, seen, fit, distances2)
        self._motion = self._motion.moved(fit.T_wc, depth_time(frame))
        return _result(fit.T_wc, self._motion.to_colour(frame), verdict, seen, reason, fit, distances2)

    def _too_few(self, seen: Observation) -> str:
        return f"{seen.count} depth points, {self._config.min_points} needed"

    def place(self, frame: Frame, target: MapSnapshot, T_wc: Float64) -> TrackResult:
        """Take the pose [4, 4] as given; say only how the frame's points lie to the map there."""
        seen = self._observe(frame)
        self._aim(target, seen.spacing)
        self._motion = Motion.at_rest(T_wc, depth_time(frame))
        return _result(T_wc, np.eye(4), Verdict.CONVERGED, seen, distances2=self._distances2(seen, T_wc))

    def correct(self, frame: Frame, T_wc: Float64) -> None:
        """Take ``T_wc`` [4, 4] as the pose of the last frame's colour: somebody knows better."""
        assert self._motion is not None and self._before is not None
        T_wd = T_wc @ lie.inverse(self._motion.to_colour(frame))
        self._motion = self._before.moved(T_wd, depth_time(frame))

    def moved(self, T_wc: Float64) -> None:
        """The points that poses rest on stay where they are, whatever becomes of a keyframe's pose."""

    def to_colour(self, frame: Frame) -> Float64:
        """Return the motion [4, 4] from the camera of the last frame's depth to that of its colour."""
        assert self._motion is not None
        return self._motion.to_colour(frame)

    def _observe(self, frame: Frame) -> Observation:
        image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
        if image is None:
            raise ValueError(f"frame {frame.index} has no depth: GICP tracking needs it")
        return observe(image, self._camera, self._config.observation, device=self._device)

    def _aim(self, target: MapSnapshot, spacing: float) -> None:
        """Prepare the map for registration, unless it is the one already prepared."""
        if target.version != self._target_version:
            self._target = build_target(
                target.means, target.quats, target.scales, cell_size=2.5 * spacing, device=self._device
            )
            self._target_version = target.version

    def _stages(self, spacing: float) -> list[Stage]:
        c = self._config
        *coarse, fine = [max(radius, c.reach * spacing) for radius in c.radii]
        *coarse_iterations, fine_iterations = c.iterations
        stages = [
            Stage(radius, n, c.coarse_tolerance, c.robust_scale * radius / fine, c.coarse_thinning)
            for radius, n in zip(coarse, coarse_iterations, strict=True)
        ]
        return [*stages, Stage(fine, fine_iterations, c.tolerance, c.robust_scale)]

    def _search(self, seen: Observation, predicted: Float64) -> tuple[Registration, Float32]:
        """Register from the prediction; where that fits badly, from poses around it and the last good one."""
        assert self._motion is not None
        best = self._fit(seen, predicted)
        if _overlap(best[1]) >= self._config.sure_overlap:
            return best
        turn = self._config.search_turn * (1 + self._motion.lost)
        turns = [np.zeros(3), *(sign * turn * axis for axis in np.eye(3)[:2] for sign in (1.0, -1.0))]
        for base in (self._motion.T_wc, predicted):
            for w in turns:
                other = self._fit(seen, base @ lie.se3_exp([0.0, 0.0, 0.0, *w]))
                if _overlap(other[1]) > _overlap(best[1]):
                    best = other
        return best

    def _fit(self, seen: Observation, T_start: Float64) -> tuple[Registration, Float32]:
        assert self._target is not None
        fit = self._registrar.register(seen.cloud, self._target, T_start, self._stages(seen.spacing))
        return fit, self._distances2(seen, fit.T_wc)

    def _distances2(self, seen: Observation, T_wc: Float64) -> Float32:
        """Return [n] squared distance of each point to the map, m^2; inf where nothing is near."""
        assert self._target is not None
        reach = max(self._config.overlap_distance, self._config.reach * seen.spacing)
        return match_distances2(seen.cloud, self._target, T_wc, radius=reach, device=self._device)

    def _judge(self, fit: Registration, predicted: Float64, overlap: float) -> tuple[Verdict, str]:
        config = self._config
        assert self._motion is not None
        allowed = 1 + self._motion.lost
        jump = lie.se3_log(lie.inverse(predicted) @ fit.T_wc)
        distance, turn = float(np.linalg.norm(jump[:3])), float(np.linalg.norm(jump[3:]))
        slid = slide(fit.information)
        jumped = distance > allowed * config.max_jump or turn > allowed * config.max_turn
        jump_reason = f"jump of {distance:.2f} m, {np.degrees(turn):.0f} degrees"
        overlap_reason = f"overlap {overlap:.2f} with the map"
        slide_reason = f"position free to slide by {slid:.3f} m"
        if overlap < config.lost_overlap:
            return Verdict.LOST, overlap_reason
        if not np.isfinite(slid):
            return Verdict.LOST, "the geometry does not fix the pose"
        # One weakness alone can be the scene's; two together are a wrong pose.
        if jumped and overlap < config.sure_overlap:
            return Verdict.LOST, f"{jump_reason}, {overlap_reason}"
        if slid > config.max_slide and overlap < config.poor_overlap:
            return Verdict.LOST, f"{slide_reason}, {overlap_reason}"
        if slid > config.max_slide:
            return Verdict.POOR, slide_reason
        if overlap < config.poor_overlap:
            return Verdict.POOR, overlap_reason
        return (Verdict.POOR, jump_reason) if jumped else (Verdict.CONVERGED, "")

    def _lose(
        self,
        frame: Frame,
        predicted: Float64,
        reason: str,
        seen: Observation,
        fit: Registration | None = None,
        distances2: Float32 | None = None,
    ) -> TrackResult:
        assert self._motion is not None
        self._motion.lost += 1
        shift = self._motion.to_colour(frame)
        return _result(predicted, shift, Verdict.LOST, seen, reason, fit, distances2)


def _overlap(distances2: Float32) -> float:
    return float(np.isfinite(distances2).mean()) if len(distances2) else 0.0


def _result(
    T_wd: Float64,
    T_dc: Float64,
    verdict: Verdict,
    seen: Observation,
    reason: str = "",
    fit: Registration | None = None,
    distances2: Float32 | None = None,
) -> TrackResult:
    """Report the pose and the points as of the colour image; ``T_wd`` is the pose when depth was taken."""
    if distances2 is None:
        distances2 = np.full(seen.count, np.inf, np.float32)
    matched = distances2[np.isfinite(distances2)]
    T_cd = lie.inverse(T_dc)
    return TrackResult(
        T_wc=T_wd @ T_dc,
        verdict=verdict,
        reason=reason,
        overlap=_overlap(distances2),
        rmse=float(np.sqrt(matched.mean(dtype=np.float64))) if len(matched) else 0.0,
        iterations=fit.iterations if fit else 0,
        points=lie.transform_points(T_cd, to_host(seen.cloud.points)).astype(np.float32),
        quats=lie.rotate_quats(T_cd[:3, :3], to_host(seen.quats)).astype(np.float32),
        scales=to_host(seen.scales),
        spreads=to_host(seen.spreads),
        distances2=distances2,
        pixels=to_host(seen.pixels),
    )
