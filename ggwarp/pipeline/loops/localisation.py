# SPDX-License-Identifier: Apache-2.0
"""Where a recording begins in the map of an earlier run.

The map is looked at from where its own camera has been. The views that look like a frame give poses by
matched features with depth; a pose is registered to the map's points, both are weighed by their covariances,
and it counts only where the map, rendered from there, is what the frame shows. A wrong place is worse than
none: where two are as good, the next frame is waited for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.pipeline.loops.feature_alignment import FeatureAligner, FeatureAlignment
from ggwarp.pipeline.loops.features import FeatureExtractor, Features
from ggwarp.pipeline.loops.places import Place
from ggwarp.pipeline.loops.recognition import VisualIndex
from ggwarp.pipeline.tracking.gicp import GicpTracker
from ggwarp.pipeline.tracking.preprocess import observe
from ggwarp.pipeline.tracking.relocalisation import SmallViews
from ggwarp.pipeline.tracking.tracker import Tracker, TrackingConfig
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.solvers.registration import Registrar, build_target
from ggwarp.solvers.registration_stages import cell_size, register_coarse_to_fine, scaled_information
from ggwarp.types import Float64, Frame, MapSnapshot, Rendered, TrackResult, Verdict

_ALIKE = 20
"""So many views are compared with a frame by their features, those that look most alike."""

_INLIERS = 12
"""Matched features that agree, at least."""

_TRIED = 3
"""So many places are registered at most, those with most matches."""

_RIVAL = 0.5
"""Another place with more than this share of the best one's matches makes a frame ambiguous."""

_APART = 0.3
"""Poses farther from each other are two places, metres and radians."""

_LEAST_OVERLAP = 0.5
"""Of a frame's points, so many lie on the map, and of its small picture's on the render."""

_LEAST_POINTS = 200
"""A frame with fewer points is not found."""

_PATIENCE = 300
"""After so many frames that are not found the run ends: ten seconds of a video."""

_OPAQUE = 0.95
_SOLID = 0.03
"""A render shows a surface where expected and median depth differ by no more than this share."""


class NotFoundError(RuntimeError):
    """The camera was not found in an earlier run's map: one line for the user."""


@state_value
@dataclass(frozen=True)
class FoundPlace:
    """Where a recording was found to begin.

    Attributes:
        frame: the recording's that was found. near: the earlier run's that looks like it.
        matches: features that agree.
        overlap: share of the frame's points that lie on the map.
        T_wc: [4, 4] its pose.
    """

    frame: int
    near: int
    matches: int
    overlap: float
    T_wc: Float64


@dataclass(frozen=True)
class _Match:
    place: Place
    found: FeatureAlignment

    @property
    def T_wc(self) -> Float64:
        return self.place.T_wc @ self.found.T_ab


def frame_of(rendered: Rendered, index: int) -> Frame:
    """Return a render as a frame, with depth where it shows a surface; ``index``: of :func:`view_index`."""
    depth = rendered.surface_depth
    solid = rendered.opacity > _OPAQUE
    solid &= np.abs(depth - rendered.median_depth) <= _SOLID * rendered.median_depth
    rgb = np.rint(255.0 * rendered.rgb).astype(np.uint8)
    return Frame(index, 0.0, rgb, np.where(solid, depth, np.float32(0)))


def view_index(frame: int) -> int:
    """Return the index of the view from an earlier run's ``frame``: negative; and the frame of such a one."""
    return -1 - frame


class Localiser(Stateful):
    """Finds a recording's first frame in an earlier map, and starts the tracker there.

    Attributes:
        views: what the map shows at its places, by index, for a mapper's state; none from the first frame on.
        place: where it was found; None: not yet.
        name: of the earlier run.
    """

    STATE = ("_missed", "place")

    def __init__(
        self,
        config: TrackingConfig,
        camera: Camera,
        sensor_camera: Camera,
        places: Sequence[Place],
        views: dict[int, Frame],
        render: Callable[[Float64], Rendered],
        *,
        name: str,
        device: Any = "cpu",
    ) -> None:
        """Know the earlier map's ``places``.

        Args:
            camera, sensor_camera: of the frames' pictures and of their sensor depth.
            views: place's index -> what the map shows there.
            render: shows the map to ``camera`` at a pose [4, 4].
            name: of the earlier run, for messages.
        """
        self._extractor = FeatureExtractor(camera, sensor_camera)
        self._aligner = FeatureAligner(camera, config.gicp.depth_noise)
        self._pictures = SmallViews(sensor_camera)
        self._gicp_config, self._sensor_camera, self._device = config.gicp, sensor_camera, device
        self._places, self._render, self.name = list(places), render, name
        self._looks = VisualIndex(lambda number: self._places[number].features.descriptors)
        for _ in places:
            self._looks.add()
        self.views = views
        self._missed: list[int] = []
        self.place: FoundPlace | None = None

    def start(self, tracker: Tracker, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Start ``tracker`` with ``frame`` where it is found; lost where it is not.

        Args:
            target: the earlier map's trackable points.

        Raises:
            NotFoundError: many frames were not.
        """
        self.views.clear()
        found = self._locate(frame, target)
        if found is not None:
            begun = tracker.start(frame, found.T_wc)
            if begun.verdict is not Verdict.LOST:
                self.place = found
                # Nothing is known of the frames before; they were not far.
                earlier = dict.fromkeys(self._missed, found.T_wc)
                return replace(self._with_distances(begun, frame, target), earlier_poses=earlier)
        self._missed.append(frame.index)
        if len(self._missed) >= _PATIENCE:
            raise self._not_found()
        reason = f"not yet found in {self.name}'s map"
        return TrackResult(self._places[-1].T_wc, Verdict.LOST, reason)

    @property
    def failure(self) -> NotFoundError | None:
        """What a run ends with of which no frame was found; None: one was."""
        return None if self.place is not None else self._not_found()

    def _not_found(self) -> NotFoundError:
        return NotFoundError(
            f"{self.name}: none of {len(self._missed)} frames was found in this run's map, and nothing is "
            "saved; begin with a view that it has, or without --start-from"
        )

    def _with_distances(self, begun: TrackResult, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return ``begun`` with how near the map its points are: a tracker starts in an empty one."""
        placed = self._placed(frame, target, begun.T_wc)
        if begun.points is None or placed.points is None:
            return begun
        if len(begun.points.points) != len(placed.points.points):  # a tracker of one's own samples otherwise
            return begun
        points = replace(begun.points, distances2=placed.points.distances2)
        return replace(begun, points=points, overlap=points.overlap)

    def _placed(self, frame: Frame, target: MapSnapshot, T_wc: Float64) -> TrackResult:
        """Return how the points of ``frame`` lie to the map if it was taken from ``T_wc`` [4, 4]."""
        tracker = GicpTracker(self._gicp_config, self._sensor_camera, device=self._device)
        return tracker.place(frame, target, T_wc)

    def _locate(self, frame: Frame, target: MapSnapshot) -> FoundPlace | None:
        matches = self._matches(self._extractor.extract(frame))
        best: FoundPlace | None = None
        for match in matches[:_TRIED]:
            if best is not None and (
                match.found.count <= _RIVAL * best.matches or not _apart(match.T_wc, best.T_wc)
            ):
                continue
            located = self._verified(frame, target, match)
            if located is None:
                continue
            if best is not None and _apart(located.T_wc, best.T_wc):
                return None
            best = best or located
        return best

    def _matches(self, features: Features) -> list[_Match]:
        """Return the places that may show what the frame shows, those with most matches first."""
        alike = np.argsort(-self._looks.similarities_to(features.descriptors), kind="stable")[:_ALIKE]
        found = []
        for number in alike.tolist():
            place = self._places[number]
            motion = self._aligner.align_features(
                place.features, features, least=_INLIERS, seed=(number, len(features))
            )
            if motion is not None:
                found.append(_Match(place, motion))
        return sorted(found, key=lambda m: -m.found.count)

    def _verified(self, frame: Frame, target: MapSnapshot, match: _Match) -> FoundPlace | None:
        """Return the place by features and points together, if the map is there what the frame shows."""
        registered = self._register(frame, target, match.T_wc)
        if registered is None:
            return None
        T_wc, by_points = registered
        step = se3.se3_log(se3.inverse(T_wc) @ match.T_wc)
        by_features = match.found.information
        T_wc = T_wc @ se3.se3_exp(np.linalg.solve(by_points + by_features, by_features @ step))
        placed = self._placed(frame, target, T_wc)
        shown = frame_of(self._render(T_wc), match.place.index)
        seen = self._pictures.compare(self._pictures.view(frame), [self._pictures.view(shown)], [np.eye(4)])
        if min(placed.overlap, seen.shared) < _LEAST_OVERLAP or not seen.is_consistent:
            return None
        near = view_index(match.place.index)
        return FoundPlace(frame.index, near, match.found.count, placed.overlap, T_wc)

    def _register(
        self, frame: Frame, target: MapSnapshot, T_start: Float64
    ) -> tuple[Float64, Float64] | None:
        """Return the pose [4, 4] by the frame's points, and its information [6, 6]; None: too few."""
        image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
        assert image is not None, "tracked by depth"
        seen = observe(
            image, self._sensor_camera, self._gicp_config, weights=frame.depth_weight, device=self._device
        )
        if seen.count < _LEAST_POINTS:
            return None
        goal = build_target(
            target.means,
            target.quats,
            target.scales,
            cell_size=cell_size(seen.spacing),
            device=self._device,
        )
        registrar = Registrar(device=self._device)
        fit = register_coarse_to_fine(registrar, seen.cloud, goal, T_start, seen.spacing)
        return fit.T_wc, scaled_information(fit)


def _apart(one: Float64, other: Float64) -> bool:
    motion = se3.se3_log(se3.inverse(one) @ other)
    return bool(max(np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])) > _APART)
