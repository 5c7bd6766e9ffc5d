# SPDX-License-Identifier: Apache-2.0
"""Loop closing: keyframes that see a place again pull the trajectory, and the map with it, together.

A false loop is worse than none. One that contradicts the poses as they are counts only where features agree
in number, where the surfaces can be laid on each other there, where the two views do not see through each
other and look alike, and where another pair of keyframes says the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.pipeline.loops.feature_alignment import DepthNoise, FeatureAligner
from ggwarp.pipeline.loops.features import FeatureExtractor, Features
from ggwarp.pipeline.loops.place_store import Places
from ggwarp.pipeline.loops.places import SEPARATE, Place, candidates, far_enough
from ggwarp.pipeline.loops.pose_graph import MeasuredMotion, optimise_poses
from ggwarp.pipeline.loops.recognition import VisualIndex
from ggwarp.pipeline.loops.surface_registration import Surface, SurfaceRegistration
from ggwarp.pipeline.tracking.relocalisation import SmallViews
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float64, Frame, TrackResult, Verdict

_NEIGHBOUR_INLIERS, _INLIERS = 10, 20
"""Matched features that agree, at least: between neighbours in time, and between others."""

_LOOSENESS = 0.002
"""What no measurement between two keyframes is better than, metres and radians: calibration, rolling shutter,
depth and colour not taken at once."""

_TRACKING_SLACK = 0.01
"""Tracking is not believed beyond this share of a motion: bias that its covariance does not know of."""

_LONGEST = 10
"""A place begins after so many frames at most, and with every frame whose pose is poor: tracking that slides
does not know how far the camera has gone, but features of neighbours do, as long as they see the same."""

_SEARCH = 3
"""Earlier places are looked for in so many frames at most, where poses are poor."""

_POOR = 10.0
"""How much larger a tracked motion's deviation is than stated where a frame on the way was poor or lost."""

_UNKNOWN = 0.02
"""Standard deviation of a tracked motion where the tracker states none, metres and radians."""

_MEMORY = 10
"""A loop waits for a second opinion while so many places come."""

_PAUSE = 5
"""The pose graph is solved after so many places at the earliest: its cost grows with the walk."""

_AGREEMENT = 0.3
"""Two loops say the same where their corrections differ by less than this share of them."""


Scope = Callable[[], AbstractContextManager[object]]
"""Returns what work on the device is done in."""

state_value(PoseCorrection)


@state_value
@dataclass(frozen=True)
class Closure:
    """How poses changed: a loop that was closed, or, where frames have no depth, views adjusted together.

    Attributes:
        correction: how the poses change.
        frame, seen_before: frames that show the same place; the latter None: no loop.
        moved: the farthest that anything moved, metres.
        seconds: what it took.
    """

    correction: PoseCorrection
    frame: int
    seen_before: int | None
    moved: float
    seconds: float


@state_value
@dataclass(frozen=True)
class _Begun:
    """A frame where a place begins, and how it was tracked; ``doubtful``: one since the last place poorly."""

    frame: Frame
    result: TrackResult
    doubtful: bool


class LoopCloser(Stateful):
    """Watches tracked frames; says how poses change when a place is seen again.

    What a frame shows is found in a thread, beside the work on the next frame, and with that one its place is
    taken in, however fast the thread was: results are the same to the bit. A state has the frame itself.

    Attributes:
        seconds: spent so far.
    """

    STATE = (
        "_places",
        "_looks",
        "_surfaces",
        "_motions",
        "_waiting",
        "_searched",
        "_solved",
        "_doubtful",
        "_begun",
        "_fixed",
        "seconds",
    )

    def __init__(
        self,
        camera: Camera,
        sensor_camera: Camera,
        depth_noise: DepthNoise,
        *,
        least_move: float,
        device: Any,
        folder: Callable[[], Path] | None = None,
    ) -> None:
        """Know no place yet.

        Args:
            camera, sensor_camera: of the frames' pictures and of their sensor depth.
            depth_noise: depths, metres -> standard deviations of readings, metres.
            least_move: poses are left alone where nothing would move farther, metres.
            folder: tells where a file of what places show goes; None: it stays in memory.
        """
        self._extractor = FeatureExtractor(camera, sensor_camera)
        self._aligner = FeatureAligner(camera, depth_noise)
        self._surfaces = SurfaceRegistration(device=device)
        self._pictures = SmallViews(sensor_camera)
        self._least_move = least_move
        self._places = Places(self._pictures, folder)
        self._looks = VisualIndex(self._places.descriptors)
        self._motions: list[MeasuredMotion] = []
        self._waiting: list[MeasuredMotion] = []
        self._searched = self._solved = self._fixed = 0
        self._doubtful = False
        self._begun: _Begun | None = None
        self._looked: Future[tuple[Place, list[MeasuredMotion]]] | None = None
        self.seconds = 0.0

    def adopt(self, places: Sequence[Place]) -> None:
        """Begin with ``places`` of an earlier map, which stay where they are; before the first frame."""
        for place in places:
            self._take_in(place)
        self._fixed = len(self._places)

    def observe(self, frame: Frame, result: TrackResult, scope: Scope = nullcontext) -> Closure | None:
        """Take in a tracked frame; return the loop that the frame before it closes, if it does.

        Poses are then those before the correction: ``correction.at([index])[0] @ T_wc`` are those after.

        Args:
            scope: of work on the device.
        """
        closure, started = self.finish(scope), time.perf_counter()
        if closure is not None:
            [motion] = closure.correction.at([frame.index])
            result = replace(result, T_wc=se3.orthonormalised(motion @ result.T_wc))
        self._doubtful |= result.verdict is not Verdict.CONVERGED
        if self._is_due(frame, result):
            self._begun, self._doubtful = _Begun(frame, result, self._doubtful), False
            self._looked = self._begin_to_look(self._begun)
        self.seconds += time.perf_counter() - started
        return closure

    def finish(self, scope: Scope = nullcontext) -> Closure | None:
        """Take in the place that the last frame begins, if it does; return the loop that it closes.

        Args:
            scope: of work on the device.
        """
        if self._begun is None:
            return None
        started = time.perf_counter()
        begun, looked = self._begun, self._looked or self._begin_to_look(self._begun)
        self._begun = self._looked = None
        self._add(begun, *looked.result(), scope)
        closure = self._close(started)
        self.seconds += time.perf_counter() - started
        return closure

    def _begin_to_look(self, begun: _Begun) -> Future[tuple[Place, list[MeasuredMotion]]]:
        number = len(self._places)
        before = [(a, self._places.features(a)) for a in range(max(number - 2, self._fixed), number)]
        worker = ThreadPoolExecutor(1, thread_name_prefix="ggwarp-loops")
        looked = worker.submit(self._look, begun, number, before)
        worker.shutdown(wait=False)  # its thread ends with this place: no run leaves one behind
        return looked

    def _look(
        self, begun: _Begun, number: int, before: list[tuple[int, Features]]
    ) -> tuple[Place, list[MeasuredMotion]]:
        """Return place ``number``, and its motions by features from those ``before``, which have numbers."""
        frame, result, points = begun.frame, begun.result, begun.result.points
        assert points is not None
        features = self._extractor.extract(frame)
        depth, view = float(np.median(points.points[:, 2])), self._pictures.view(frame)
        place, motions = Place(frame.index, result.T_wc, depth, features, view, Surface.of(points)), []
        for a, one in before:
            found = self._aligner.align_features(one, features, least=_NEIGHBOUR_INLIERS, seed=(a, number))
            if found is not None:
                motions.append(_measured(a, number, found.T_ab, found.information))
        return place, motions

    def _take_in(self, place: Place) -> None:
        self._places.add(place)
        self._looks.add()

    def _is_due(self, frame: Frame, result: TrackResult) -> bool:
        if result.verdict is Verdict.LOST or result.points is None or not len(result.points.points):
            return False
        if not len(self._places) or far_enough(self._places.poses[-1], result.T_wc):
            return True
        return result.verdict is Verdict.POOR or frame.index - self._places.poses[-1].index >= _LONGEST

    def _add(self, begun: _Begun, place: Place, motions: list[MeasuredMotion], scope: Scope) -> None:
        self._take_in(place)
        frame, result, number = begun.frame, begun.result, len(self._places) - 1
        if number:
            self._motions.append(self._tracked(number, begun))
        self._motions += motions
        searched = self._places.poses[self._searched]
        if number and frame.index - searched.index < _SEARCH and not far_enough(searched, result.T_wc):
            return
        self._searched = number
        for a in candidates(self._places.poses, self._looks):
            motion = self._loop(a, number, scope)
            if motion is None or not self._looks_true(motion):
                continue
            agrees = self._displacement(motion) <= self._least_move
            (self._motions if agrees else self._waiting).append(motion)

    def _tracked(self, b: int, begun: _Begun) -> MeasuredMotion:
        """Return the motion since the last place as it was tracked."""
        result = begun.result
        T_ab = se3.inverse(self._places.poses[b - 1].T_wc) @ self._places.poses[b].T_wc
        # What nothing is known of is not certain to be there, either: a wall leaves two directions open.
        information = np.eye(6) / _UNKNOWN**2
        if result.information is not None and np.isfinite(result.information).all():
            information = information + 0.5 * result.information  # both ends
        covariance = np.linalg.inv(information)
        # No way lies between an earlier map and the frame that was found in it.
        size = 0.0 if b == self._fixed else np.linalg.norm(se3.se3_log(T_ab))
        deviation = _LOOSENESS + _TRACKING_SLACK * float(size)
        covariance = covariance + deviation**2 * np.eye(6)
        return MeasuredMotion(b - 1, b, T_ab, covariance * (_POOR**2 if begun.doubtful else 1.0))

    def _loop(self, a: int, b: int, scope: Scope) -> MeasuredMotion | None:
        """Return the motion between two places by features; None where surfaces do not agree with it."""
        one, other = self._places.features(a), self._places.features(b)
        found = self._aligner.align_features(one, other, least=_INLIERS, seed=(a, b))
        if found is None:
            return None
        surfaces = self._places.surface(a), self._places.surface(b)
        with scope():
            agree = self._surfaces.agree(*surfaces, found.T_ab, found.information)
        return _measured(a, b, found.T_ab, found.information) if agree else None

    def _looks_true(self, motion: MeasuredMotion) -> bool:
        """Whether the two views, so placed, neither see through each other nor look different."""
        a, b = self._places.view(motion.a), self._places.view(motion.b)
        return self._pictures.compare(b, [a], [motion.T_ab]).is_consistent

    def _correction_by(self, motion: MeasuredMotion) -> Float64:
        """Return the motion [4, 4] of the world that brings place b to where a says it is."""
        a, b = self._places.poses[motion.a], self._places.poses[motion.b]
        return a.T_wc @ motion.T_ab @ se3.inverse(b.T_wc)

    def _displacement(self, motion: MeasuredMotion) -> float:
        return self._places.poses[motion.b].displacement(self._correction_by(motion))

    def _close(self, started: float) -> Closure | None:
        """Close the loops that wait and are confirmed, where anything moves by that."""
        newest = len(self._places) - 1
        self._waiting = [m for m in self._waiting if newest - m.b <= _MEMORY]
        confirmed = [m for m in self._waiting if any(self._confirms(other, m) for other in self._waiting)]
        if not confirmed or newest - self._solved < _PAUSE:
            return None
        self._solved = newest
        before = np.stack([p.T_wc for p in self._places.poses])
        after = optimise_poses(before, [*self._motions, *confirmed], fixed=max(self._fixed, 1))
        after[: self._fixed] = before[: self._fixed]
        motions = after @ np.linalg.inv(before)
        motions[: self._fixed] = np.eye(4)
        moved = max(p.displacement(motion) for p, motion in zip(self._places.poses, motions, strict=True))
        if moved <= self._least_move:
            return None
        self._waiting = [m for m in self._waiting if not any(m is other for other in confirmed)]
        self._motions += confirmed
        for place, T_wc in zip(self._places.poses, after, strict=True):
            place.T_wc = se3.orthonormalised(T_wc)
        correction = PoseCorrection(tuple(p.index for p in self._places.poses), motions)
        loop = max(confirmed, key=lambda m: m.b - m.a)
        seen_before, frame = self._places.poses[loop.a].index, self._places.poses[newest].index
        return Closure(correction, frame, seen_before, moved, time.perf_counter() - started)

    def _confirms(self, one: MeasuredMotion, other: MeasuredMotion) -> bool:
        """Whether two loops that share no view say the same."""
        if (one.b == other.b and abs(one.a - other.a) < SEPARATE) or one.a == other.a:
            return False
        place = self._places.poses[other.b]
        correction, difference = self._correction_by(other), self._correction_by(one)
        difference = difference @ se3.inverse(correction)
        allowed = self._least_move + _AGREEMENT * place.displacement(correction)
        return place.displacement(difference) <= allowed


def _measured(a: int, b: int, T_ab: Float64, information: Float64) -> MeasuredMotion:
    return MeasuredMotion(a, b, T_ab, np.linalg.inv(information) + _LOOSENESS**2 * np.eye(6))
