# SPDX-License-Identifier: Apache-2.0
"""The SLAM system: track a frame, decide what it adds, add it, fit the map.

It has two sides that share no state: the tracker's (:meth:`Slam.track_frame`: tracker, keyframe policy,
trackable points) and the mapper's (:meth:`Slam.map_frame`: the Gaussians, the reports). A
:class:`TrackedFrame` goes from one to the other.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import Gaussians, join
from ggwarp.map.renderer import Renderer
from ggwarp.map.submap import MapBudget
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.objects.linear_classifier import LinearClassifier
from ggwarp.pipeline.assembly import make_mapper, make_policy
from ggwarp.pipeline.earlier_map import MapParts, enter_map, with_views
from ggwarp.pipeline.estimated_poses import EstimatedPoses
from ggwarp.pipeline.loops.loop_closer import Closure
from ggwarp.pipeline.loops.tracking_side import TrackingLoops
from ggwarp.pipeline.scheduler import Scheduler, SynchronousScheduler, Waiting
from ggwarp.pipeline.slam_config import SlamConfig
from ggwarp.pipeline.tracked_frame import TrackedFrame
from ggwarp.pipeline.tracking.keyframe_policy import KeyframeKind
from ggwarp.pipeline.tracking.point_map import TrackableMap
from ggwarp.pipeline.tracking.tracker import TrackerContext, make_tracker
from ggwarp.results.run_folder import write_system
from ggwarp.results.saved_run import SavedRun
from ggwarp.runtime import loading
from ggwarp.runtime.image_store import ImageStore
from ggwarp.runtime.state import FrameSource, State, Stateful, restore_into, state_of
from ggwarp.runtime.streams import NO_LOCK, stream_scopes
from ggwarp.types import Float64, Frame, Rendered, StepReport, TrackResult

_TRACKING_STATE = ("_tracker", "_policy", "_trackable", "_earlier_poses", "_restart_at", "loops", "localiser")
_MAPPING_STATE = ("_mapper", "reports", "counts", "_unmapped", "_poses", "_moved_by")


class Slam:
    """Object-level RGB-D SLAM, one frame at a time.

    Attributes:
        device: Warp device. camera: of the frames' pictures. reports: one row a frame.
        map: the Gaussians, those on the device.
        keyframe_indices: frames that were ever used for mapping.
        counts: tracking_keyframes, mapping_keyframes, frames_lost, loops_closed; the mapper's ``left_out``.
        loops: closes them; says why they stay open.
        localiser: finds the first frame in an earlier run's map; None: a new map begins with it.
        mapping_scope: to be held by others who look at the map between frames.
    """

    def __init__(
        self,
        config: SlamConfig,
        camera: Camera,
        sensor_camera: Camera,
        *,
        device: Any = "cpu",
        scheduler: Scheduler | None = None,
        images: ImageStore | None = None,
        map_budget: MapBudget | None = None,
        earlier: SavedRun | None = None,
    ) -> None:
        """Build the map, empty or as an ``earlier`` run left it, and the parts that work on it.

        Args:
            camera: of the frames' ``rgb``, ``depth`` and ``mask``.
            sensor_camera: of the frames' ``sensor_depth``.
            scheduler: when frames come and how much mapping they get; None: ``config.mapper.iterations``.
            images: holds those of the keyframes, on ``device``; None: they and loops' places stay in memory.
            map_budget: what of the map is on ``device``; None: all of it.
            earlier: goes on in its map: the first frame is looked for in it. Needs depth.

        Raises:
            EmptyMapError: there is nothing in the earlier map to find a frame by.
        """
        chosen = "covisibility" if config.tracker == "photometric" else "overlap"
        self.config = dataclasses.replace(config, policy=chosen) if config.policy == "auto" else config
        self.device, self.camera, self._sensor_camera = device, camera, sensor_camera
        self.earlier, self._stores = earlier, {"images": images, "budget": map_budget}
        self._scheduler = scheduler or SynchronousScheduler(config.mapper.iterations)
        self._tracking_scope = self.mapping_scope = NO_LOCK
        self._restart_at: Float64 | None = None
        self._moved_by: int | None = None
        self._unmapped, self._poses = 0, EstimatedPoses()
        self.reports: list[StepReport] = []
        self.counts = {"tracking_keyframes": 0, "mapping_keyframes": 0, "frames_lost": 0, "loops_closed": 0}
        self._build()

    def _build(self) -> None:
        """Make the map, and the parts that work on it."""
        config, device, camera, images = self.config, self.device, self.camera, self._stores["images"]
        self._trackable = TrackableMap(config.trackable, device=device)
        self._earlier_poses: dict[int, Float64] = {}
        self._mapper = make_mapper(config, camera, device=device, **self._stores)
        self.map = self._mapper.map
        self._policy = make_policy(config, self._mapper)
        renderer, cameras = Renderer(self.map, camera, identity=False), (camera, self._sensor_camera)
        self._tracker = make_tracker(TrackerContext(config, *cameras, renderer, device, config.mono))
        self.loops = TrackingLoops(config, cameras, self._tracker, self._policy, self._trackable, images)
        parts = MapParts(self._mapper, self._trackable, self._tracker, self.loops)
        self.localiser = None if self.earlier is None else enter_map(self.earlier, config, cameras, parts)

    def step(self, frame: Frame) -> StepReport:
        """Process the next frame: pose first, then the map."""
        return self.map_frame(self.track_frame(frame))

    def track_frame(self, frame: Frame) -> TrackedFrame:
        """Find the next frame's pose and what it adds (the tracker's side)."""
        arrival = self._scheduler.wait_for_frame()
        started = time.perf_counter()
        with self._tracking_scope:
            result = self._track(frame)
        seconds = time.perf_counter() - started
        kind = self._policy.decide(result)
        if new := kind is KeyframeKind.TRACKING:
            self._trackable.add(result.points, result.T_wc, frame.index)
        closed = self.loops.close(frame, result, lambda: self._tracking_scope, is_keyframe=new)
        result, closure, loop_s = closed
        if closure is not None:
            self._earlier_poses = closure.correction.moved(self._earlier_poses)
        return TrackedFrame(frame, arrival, result, kind, seconds + loop_s, closure, loop_s)

    def map_frame(self, tracked: TrackedFrame, waiting: Waiting | None = None) -> StepReport:
        """Add what the frame adds and fit the map (the mapper's side).

        Args:
            tracked: frames in the order in which they were tracked.
            waiting: asks whether the next frame waits already, where tracking runs in a thread of its own.
        """
        started = time.perf_counter()
        self._move(tracked.closure, tracked.frame.index)
        tracked = self._insert(tracked)
        iterations = self._fit(tracked, waiting)
        loss = self._synchronise(tracked)
        seconds = time.perf_counter() - started
        return self._report(tracked, seconds, iterations, loss)

    def leave_unmapped(self, tracked: TrackedFrame) -> StepReport:
        """Report a frame that the map will never see: the run ends before its turn."""
        self._unmapped += 1
        with contextlib.suppress(Exception):  # where mapping has failed, what is there stays as it is
            self._move(tracked.closure, tracked.frame.index)
        return self._report(dataclasses.replace(tracked, kind=KeyframeKind.NONE), 0.0, 0, math.nan)

    @property
    def has_state(self) -> bool:
        """Whether its state is whole: not with a tracker that has none, nor with frames left unmapped."""
        return isinstance(self._tracker, Stateful) and self._unmapped == 0

    def tracking_state(self) -> State:
        """Return the state of the tracker's side, between two of its frames."""
        with self._tracking_scope:
            return state_of(self, _TRACKING_STATE)

    def mapping_state(self) -> State:
        """Return the state of the mapper's side, between two of its frames."""
        with self.mapping_scope:
            return state_of(self, _MAPPING_STATE)

    def restore(self, tracking: State, mapping: State, frames: FrameSource) -> None:
        """Go on from both sides' states after the same frame; before the first frame of this system.

        Raises:
            StateError, KeyError, TypeError, ValueError: they are no states of such a system.
        """
        restore_into(self, _TRACKING_STATE, tracking, frames)
        restore_into(self, _MAPPING_STATE, mapping, with_views(frames, self.localiser))
        if self.localiser is not None:
            self.localiser.views.clear()

    @contextlib.contextmanager
    def in_two_threads(self) -> Iterator[None]:
        """Allow :meth:`track_frame` and :meth:`map_frame` to be called from a thread each.

        Raises:
            ValueError: tracking looks at the Gaussians being mapped.
        """
        if self.sequential_only:
            raise ValueError("tracking looks at the Gaussians being mapped: it works in turn with the mapper")
        # Two threads must not compile a kernel at once.
        loading.load(loading.imported_kernel_modules(self.device), self.device)
        with stream_scopes(self.device) as scopes:
            self._tracking_scope, self.mapping_scope = scopes
            try:
                yield
            finally:
                self._tracking_scope = self.mapping_scope = NO_LOCK

    def skip_frame(self) -> None:
        """Let the time of a frame pass that cannot be used."""
        self._scheduler.wait_for_frame()

    @property
    def can_refine(self) -> bool:
        """Whether there is a map to fit."""
        return self._mapper.ready

    def refine(self) -> None:
        """Fit the map once more, without a new frame."""
        self._mapper.iterate()
        self._mapper.synchronise()

    def finish(self) -> None:
        """Close the last frame's loop and fit the map to what was out of memory, once there are no more."""
        if (closure := self.loops.finish(lambda: self._tracking_scope)) is not None:
            self._earlier_poses = closure.correction.moved(self._earlier_poses)
            self._move(closure, -1)  # it comes with no frame
        self._mapper.catch_up()

    def render(self, T_wc: Float64) -> Rendered:
        """Return the map's view from ``T_wc`` [4, 4] at the run's image size."""
        return self._mapper.render(T_wc)

    @property
    def sequential_only(self) -> bool:
        """Whether the tracker's side looks at the Gaussians, so that it cannot run beside the mapper."""
        return self._tracker.needs_gaussians or self._policy.needs_gaussians

    def fitted_poses(self) -> dict[int, Float64]:
        """Return each reported frame's pose T_wc [4, 4]: as fitted with the map, interpolated where lost."""
        return self._poses.final(self.reports, self._earlier_poses | self._mapper.keyframe_poses())

    @property
    def keyframe_indices(self) -> list[int]:
        return self._mapper.keyframe_indices

    @property
    def voting_indices(self) -> list[int]:
        """Frames whose mask voted for the map's objects, though they were not mapped."""
        return self._mapper.objects.voting_indices if self._mapper.objects else []

    def map_parts(self) -> Iterator[Gaussians]:
        """Yield the map on the host, with object ids, part by part."""
        return self._mapper.parts()

    def map_arrays(self) -> Gaussians:
        """Return the map on the host, with object ids."""
        return join(*self.map_parts())

    def objects(self, names: dict[int, str]) -> list[ObjectRecord]:
        """Describe the map's objects; ``names`` are their classes by id, where known."""
        return self._mapper.inventory(names)

    def linear_classifier(self) -> LinearClassifier | None:
        """Return what tells identities apart; None without identities."""
        return self._mapper.objects.linear_classifier() if self._mapper.objects else None

    def save(self, folder: str | Path, names: dict[int, str] | None = None) -> None:
        """Write what :func:`ggwarp.load_run` reads; ``names`` are the objects' classes by id, where known."""
        write_system(Path(folder), self, names or {})

    def _track(self, frame: Frame) -> TrackResult:
        if self._restart_at is not None:
            self._build()
            begun = self._tracker.start(frame, self._restart_at)
            result = dataclasses.replace(begun, reason="the start was bad: a new map begins")
        elif self._policy.empty and self.localiser is not None:
            result = self.localiser.start(self._tracker, frame, self._trackable.snapshot())
        elif self._policy.empty:
            result = self._tracker.start(frame, np.eye(4) if frame.T_wc is None else frame.T_wc)
        else:
            result = self._tracker.track(frame, self._trackable.snapshot())
        self._earlier_poses |= result.earlier_poses
        self._restart_at = result.T_wc if result.reinitialise else None
        return result

    def _move(self, closure: Closure | None, index: int) -> None:
        """Have the mapper's side follow the loop that comes with frame ``index``, once."""
        if closure is None or self._moved_by == index:
            return
        self._moved_by = index
        with self.mapping_scope:
            self._mapper.move(closure.correction)
        self._poses.move(closure.correction)
        self.counts["loops_closed"] += closure.seen_before is not None

    def _insert(self, tracked: TrackedFrame) -> TrackedFrame:
        """Give the mapper a keyframe, and what it keeps of any frame; return ``tracked`` as it was mapped."""
        frame, result = tracked.frame, tracked.result
        with self.mapping_scope:
            if tracked.is_keyframe or (self._mapper.refused and not tracked.is_lost):
                keyframe = frame if result.depth is None else dataclasses.replace(frame, depth=result.depth)
                tracked = tracked.mapped(self._mapper.insert(keyframe, result.T_wc, result.exposure))
                self.counts |= self._mapper.left_out
            if not tracked.is_lost:
                self._mapper.observe_frame(frame, result.T_wc, skip_objects=tracked.arrival.late)
        return tracked

    def _fit(self, tracked: TrackedFrame, waiting: Waiting | None) -> int:
        """Fit the map, first to its first keyframe, as long as the schedule says; return the iterations."""
        first = tracked.is_keyframe and len(self.keyframe_indices) == 1
        more, done = self.config.mapper.bootstrap if first else 0, 0
        while self._mapper.ready and (done < more or self._scheduler.should_continue(done - more, waiting)):
            with self.mapping_scope:
                self._mapper.iterate()
            done += 1
        return done

    def _synchronise(self, tracked: TrackedFrame) -> float:
        """Wait for the iterations and return their mean loss; hand on a keyframe's corrected pose."""
        with self.mapping_scope:
            loss = self._mapper.synchronise()
            corrects = tracked.is_keyframe and self._mapper.fits_poses and self.sequential_only
            T_wc = self._mapper.keyframe_pose(-1) if corrects else None
        if T_wc is not None:
            self._policy.on_pose_corrected(T_wc)
            self._tracker.on_pose_corrected(T_wc)
        return loss

    def _report(self, tracked: TrackedFrame, seconds: float, iterations: int, loss: float) -> StepReport:
        count = self._mapper.submaps.count
        report = tracked.report(seconds=seconds, iterations=iterations, gaussians=count, loss=loss)
        self.counts["frames_lost"] += tracked.is_lost
        if tracked.is_keyframe:
            self.counts[f"{tracked.kind.value}_keyframes"] += 1
        self.reports.append(report)
        self._poses.by_frame[report.index] = report.T_wc
        return report
