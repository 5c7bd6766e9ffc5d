# SPDX-License-Identifier: Apache-2.0
"""Where frames have no depth: views adjusted together as they come, and loops closed by similarities.

A map that is tracked and extended picture by picture passes its scale on from one to the next, and loses it.
Here points that views far apart show tie scales together (bundle adjustment over a window), and a place
seen again brings scale and pose back to what they were there (a pose graph over Sim(3), then all views
adjusted together). The map follows: each view's part of it moves and grows as its points do.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext

import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry import se3, sim3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.pipeline.loops.bundle_adjustment import GATES, adjust_bundle, resect
from ggwarp.pipeline.loops.feature_tracks import REACH, FeatureTracks, FeatureView
from ggwarp.pipeline.loops.features import FeatureExtractor, depth_at
from ggwarp.pipeline.loops.loop_closer import Closure, Scope
from ggwarp.pipeline.loops.places import SEPARATE, candidates
from ggwarp.pipeline.loops.recognition import VisualIndex
from ggwarp.pipeline.loops.similarity_graph import MeasuredSimilarity, align_similarity, optimise_similarities
from ggwarp.runtime.state import Stateful
from ggwarp.types import Float64, Frame, TrackResult, Verdict

_INTERVAL = 2
"""A view is taken of every so many frames at most."""

_WINDOW = 20
"""Views whose poses are adjusted together."""

_PLACED_BY = 2
"""A frame in between is placed by the points of so many views before it."""

_FIRST = 4
"""With fewer views there is nothing to adjust."""

_TELLING = 8
"""A view's scale is told by so many of its points at least."""

_INLIERS = 20
"""Matched points that agree with a loop, at least."""

_LEAST = 0.02
"""A loop that says no more, of the scene's depth or of the scale, only adds to what the window knows."""

_DRIFT = 0.01, 0.02, 0.02
"""Standard deviations of the motion from one view to the next: rotation, radians; translation, of the scene's
depth; scale. Those of a loop are the same: only their proportions count, as all views are adjusted then."""

_GATES = (30.0, 10.0, *GATES)
"""See :data:`ggwarp.pipeline.loops.bundle_adjustment.GATES`: after a loop, poses are farther off."""

_MEMORY = 20
"""A loop waits for a second opinion while so many views come."""

_AGREEMENT = 0.3
"""Two loops say the same where their corrections differ by less than this share of them."""

_PAUSE = 0.1
"""All views are adjusted again when there are more by this share: the cost grows with them."""


class MonocularLoops(Stateful):
    """Watches tracked frames; says how poses and scales change.

    Attributes:
        seconds: spent so far.
    """

    STATE = ("_tracks", "_points", "_looks", "_loops", "_waiting", "_solved", "seconds")

    def __init__(self, camera: Camera) -> None:
        """``camera``: of the frames' pictures."""
        self._camera = camera
        self._extractor = FeatureExtractor(camera, camera)
        self._tracks = FeatureTracks(camera)
        self._points: Float64 = np.zeros((0, 3))
        self._looks = VisualIndex(lambda number: self._views[number].descriptors)
        self._loops: list[MeasuredSimilarity] = []
        self._waiting: list[MeasuredSimilarity] = []
        self._solved = 0
        self.seconds = 0.0

    @property
    def _views(self) -> list[FeatureView]:
        return self._tracks.views

    def observe(self, frame: Frame, result: TrackResult, scope: Scope = nullcontext) -> Closure | None:
        """Take in a tracked frame; return how poses change by it, if they do.

        ``scope`` is not used: there is no work on the device.
        """
        started = time.perf_counter()
        closure, views = None, self._views
        if result.verdict is Verdict.LOST:
            return None
        if not views or frame.index - views[-1].index >= _INTERVAL:
            self._add(frame, result)
            if len(views) >= _FIRST:
                loop = self._confirmed_loop()
                closure = self._adjust_window(started) if loop is None else self._close(loop, started)
        elif len(views) >= _FIRST:
            closure = self._place(frame, result.T_wc, started)
        self.seconds += time.perf_counter() - started
        return closure

    def _place(self, frame: Frame, T_wc: Float64, started: float) -> Closure | None:
        """Place a frame between two views, tracked at ``T_wc`` [4, 4], by the points of the last ones."""
        pixels, descriptors = self._extractor.detect(frame.rgb)
        none = np.full(len(pixels), -1, np.intp)
        here = FeatureView(
            frame.index, T_wc, pixels, descriptors, none, np.full(len(pixels), np.nan), self._views[-1].depth
        )
        at: dict[int, int] = {}
        for view in self._views[-_PLACED_BY:]:
            for row, column in self._tracks.matches(view, here).tolist():
                if np.isfinite(view.depths[row]):
                    at[column] = int(view.tracks[row])
        if len(at) < _INLIERS:
            return None
        placed, agreeing = resect(self._camera, T_wc, self._points[list(at.values())], pixels[list(at)])
        if agreeing < max(_INLIERS, 0.5 * len(at)):
            return None
        motion = placed @ se3.inverse(T_wc)
        correction = _newest_alone((self._views[-1].index, frame.index), np.stack([np.eye(4), motion]))
        moved = here.displacement(motion)
        return Closure(correction, frame.index, None, moved, time.perf_counter() - started)

    def _add(self, frame: Frame, result: TrackResult) -> None:
        """Take a view of a tracked frame: match its features, and look for loops by them."""
        pixels, descriptors = self._extractor.detect(frame.rgb)
        n, depth = len(pixels), self._views[-1].depth if self._views else 1.0
        view = FeatureView(
            frame.index, result.T_wc, pixels, descriptors, np.full(n, -1, np.intp), np.full(n, np.nan), depth
        )
        self._tracks.add(view)
        self._looks.add()
        self._make_room()
        if len(self._views) == 1 and result.depth is not None:
            # The map begins with this: its scale is the one that stays.
            view.depths = depth_at(result.depth, pixels, frame.rgb.shape)
            view.depths[view.depths <= 0.0] = np.nan
        else:
            view.depths = self._depths(view)
        if np.isfinite(view.depths).any():
            view.depth = float(np.nanmedian(view.depths))
        b = len(self._views) - 1
        for a in candidates(self._views, self._looks, apart=REACH + 1):
            self._look_for_loop(a, b)

    def _look_for_loop(self, a: int, b: int) -> None:
        """Compare two views; let a loop that changes nothing bind the window, and one that does wait."""
        one, other = self._views[a], self._views[b]
        pairs = self._tracks.matches(one, other)
        known = pairs[np.isfinite(one.depths[pairs[:, 0]]) & np.isfinite(other.depths[pairs[:, 1]])]
        if len(known) < _INLIERS:
            return
        there, here = self._local(one, known[:, 0]), self._local(other, known[:, 1])
        found = align_similarity(self._camera, there, here, seed=(a, b))
        if found is None or found[1].sum() < _INLIERS:
            return
        S_ab, inliers = found
        rotation, translation, scale = _DRIFT
        loop = MeasuredSimilarity(a, b, S_ab, (rotation, translation * other.depth, scale))
        off = other.displacement(self._correction_by(loop)) / other.depth
        if max(off, abs(np.log(sim3.split(S_ab)[1]))) < _LEAST:
            self._tracks.join(one, other, known[inliers])
        else:
            self._waiting.append(loop)

    def _confirmed_loop(self) -> MeasuredSimilarity | None:
        """Take the loops that wait and are confirmed; return the longest of them, if it is time for it."""
        newest = len(self._views) - 1
        self._waiting = [m for m in self._waiting if newest - m.b <= _MEMORY]
        confirmed = [m for m in self._waiting if any(self._confirms(other, m) for other in self._waiting)]
        if not confirmed or newest < (1.0 + _PAUSE) * self._solved:
            return None
        self._solved = newest
        self._waiting = [m for m in self._waiting if not any(m is other for other in confirmed)]
        self._loops += confirmed
        return max(confirmed, key=lambda m: m.b - m.a)

    def _confirms(self, one: MeasuredSimilarity, other: MeasuredSimilarity) -> bool:
        """Whether two loops that share no view say the same."""
        if (one.b == other.b and abs(one.a - other.a) < SEPARATE) or one.a == other.a:
            return False
        view, correction = self._views[other.b], self._correction_by(other)
        difference = self._correction_by(one) @ np.linalg.inv(correction)
        return (
            view.displacement(difference) <= _AGREEMENT * view.displacement(correction) + _LEAST * view.depth
        )

    def _correction_by(self, loop: MeasuredSimilarity) -> Float64:
        """Return the similarity [4, 4] of the world that brings view b to where a says it is."""
        a, b = self._views[loop.a], self._views[loop.b]
        return a.T_wc @ loop.S_ab @ se3.inverse(b.T_wc)

    def _close(self, loop: MeasuredSimilarity, started: float) -> Closure | None:
        """Spread what a loop says over all views, and adjust them together."""
        before = np.stack([v.T_wc for v in self._views])
        rotation, translation, scale = _DRIFT
        way = [
            MeasuredSimilarity(
                n, n + 1, se3.inverse(before[n]) @ before[n + 1], (rotation, translation * view.depth, scale)
            )
            for n, view in enumerate(self._views[:-1])
        ]
        spread = optimise_similarities(before, [*way, *self._loops])
        for one in self._loops:
            pair = self._views[one.a], self._views[one.b]
            self._tracks.join(*pair, self._tracks.matches(*pair))
        self._make_room()
        # What was measured before holds between the poses of before, whose scales have changed since.
        self._loops.clear()
        numbers = range(len(self._views))
        poses = np.stack([se3.orthonormalised(S) for S in spread])
        return self._adjust(
            numbers, before, poses, started, seen_before=self._views[loop.a].index, gates=_GATES
        )

    def _adjust_window(self, started: float) -> Closure | None:
        """Adjust the newest views; those before them that show the same points stay."""
        begin = max(len(self._views) - _WINDOW, 1)
        shown = np.unique(np.concatenate([v.tracks for v in self._views[begin:]]))
        shares = [bool(np.isin(v.tracks[v.tracks >= 0], shown).any()) for v in self._views[:begin]]
        numbers = [n for n, share in enumerate(shares) if share or n == begin - 1]
        numbers += range(begin, len(self._views))
        before = np.stack([self._views[n].T_wc for n in numbers])
        return self._adjust(numbers, before, before, started, begin=begin)

    def _adjust(
        self,
        numbers: Sequence[int],
        before: Float64,
        poses: Float64,
        started: float,
        *,
        begin: int = 1,
        seen_before: int | None = None,
        gates: tuple[float, ...] = GATES,
    ) -> Closure | None:
        """Adjust views from other poses than theirs, and the points that they show.

        Args:
            numbers: of the views, rising. before, poses: [n, 4, 4] where these are, and where to start.
            begin: views of lower number stay.
            seen_before: see :class:`Closure`.
        """
        views = [self._views[n] for n in numbers]
        fixed = np.array(numbers) < begin
        seen, points = self._tracks.observations(numbers)
        free_points = np.unique(seen.points[~fixed[seen.views]])
        seen = seen.only(np.isin(seen.points, free_points))
        depth = views[-1].depth
        after, found = adjust_bundle(
            self._camera, poses, seen, len(points), fixed=fixed, depth=depth, gates=gates
        )
        told = seen.only(np.isfinite(found[seen.points, 0]))
        if np.count_nonzero(told.views == len(views) - 1) < _INLIERS:
            return None  # the camera has hardly moved, or before what has no features
        self._points[points[free_points]] = found[free_points]
        scales = self._scales(views, after)
        if fixed.sum() == 1:
            # One pose that stays leaves the scale free: it is that of the first view.
            gauge = 1.0 / scales[0]
            after[:, :3, 3] = before[0, :3, 3] + gauge * (after[:, :3, 3] - before[0, :3, 3])
            self._points[:] = before[0, :3, 3] + gauge * (self._points - before[0, :3, 3])
            scales *= gauge
        scales[fixed] = 1.0
        motions = np.tile(np.eye(4), (len(views), 1, 1))
        for row in np.flatnonzero(~fixed):
            motions[row] = sim3.similarity(after[row], scales[row]) @ se3.inverse(before[row])
        moved = max(v.displacement(motion) for v, motion in zip(views, motions, strict=True))
        for row in np.flatnonzero(~fixed):
            views[row].T_wc = se3.orthonormalised(after[row])
            views[row].depth *= scales[row]
        for view in views:
            view.depths = self._depths(view)
        first = int(np.flatnonzero(fixed)[-1])
        correction = _newest_alone(tuple(v.index for v in views[first:]), motions[first:])
        seconds = time.perf_counter() - started
        return Closure(correction, views[-1].index, seen_before, moved, seconds)

    def _make_room(self) -> None:
        """Let there be a place for each point."""
        new = np.full((self._tracks.count - len(self._points), 3), np.nan)
        self._points = np.concatenate([self._points, new])

    def _scales(self, views: Sequence[FeatureView], poses: Float64) -> Float64:
        """Return [n] by how much the points of each view have become more distant, seen from ``poses``."""
        scales, last = np.ones(len(views)), 1.0
        for row, (view, T_wc) in enumerate(zip(views, poses, strict=True)):
            ratios = self._depths(view, T_wc) / view.depths
            ratios = ratios[np.isfinite(ratios) & (ratios > 0.0)]
            last = float(np.median(ratios)) if len(ratios) >= _TELLING else last
            scales[row] = last
        return scales

    def _depths(self, view: FeatureView, T_wc: Float64 | None = None) -> Float64:
        """Return [n] depths of the points that a view shows, from its pose or ``T_wc``; nan: not known."""
        T_wc = view.T_wc if T_wc is None else T_wc
        depths = np.full(len(view.tracks), np.nan)
        there = view.tracks >= 0
        depths[there] = (self._points[view.tracks[there]] - T_wc[:3, 3]) @ T_wc[:3, 2]
        depths[depths <= 0.0] = np.nan
        return depths

    def _local(self, view: FeatureView, rows: NDArray[np.intp]) -> Float64:
        """Return [m, 3] the points of a view's features ``rows`` in its camera."""
        pixels = view.pixels[rows]
        return self._camera.back_project(pixels[:, 0], pixels[:, 1], view.depths[rows])


def _newest_alone(indices: tuple[int, ...], motions: Float64) -> PoseCorrection:
    """Return a correction of which the last motion is of the last frame alone.

    How that was tracked says nothing of the frames before it, which were placed by the views before them.
    """
    *earlier, before, newest = indices
    if newest - before > 1:
        indices = (*earlier, before, newest - 1, newest)
        motions = np.concatenate([motions[:-1], motions[-2:]])
    return PoseCorrection(indices, motions)
