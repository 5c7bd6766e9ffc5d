# SPDX-License-Identifier: Apache-2.0
"""What a tracker is, the trackers there are by name, and how others register their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.tracking.gicp import GicpConfig, GicpTracker
from ggwarp.pipeline.tracking.given_poses import GivenPoses
from ggwarp.pipeline.tracking.hybrid import HybridTracker
from ggwarp.pipeline.tracking.initialisation import InitialisationConfig
from ggwarp.pipeline.tracking.monocular import MonocularTracker
from ggwarp.pipeline.tracking.photometric import PhotometricTracker
from ggwarp.pipeline.tracking.pose_refinement import RefinementConfig
from ggwarp.types import Float64, Frame, MapSnapshot, TrackResult


@runtime_checkable
class Tracker(Protocol):
    """Finds each frame's pose.

    Attributes:
        needs_gaussians: whether it looks at the Gaussians being mapped, and so works in turn with the mapper.
    """

    needs_gaussians: bool

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the first frame, whose pose [4, 4] is given; again with the next one where that is lost."""
        ...

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame.

        Args:
            target: the map's trackable points; none where the tracker gives none.
        """
        ...

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """Take note that the last frame's pose [4, 4] was corrected by the mapper.

        Called only where tracking and mapping work in turn.
        """
        ...


@runtime_checkable
class FollowsMap(Protocol):
    """A tracker that goes on where a closed loop has moved the map; with another one loops stay open."""

    def on_map_moved(self, correction: PoseCorrection, index: int) -> None:
        """Take note that the map, and the poses of all frames up to the last, ``index``, were moved."""
        ...


@runtime_checkable
class RemembersViews(Protocol):
    """A tracker that finds and checks poses by where the camera has been."""

    def remember(self, frame: Frame, T_wc: Float64) -> None:
        """Know the view of ``frame``, which has depth, from ``T_wc`` [4, 4]."""
        ...


@dataclass(frozen=True)
class TrackerContext:
    """What a tracker may be built from.

    Attributes:
        config: the trackers' options.
        camera: of the frames' pictures. sensor_camera: of their sensor depth.
        renderer: of the map that is being built; for those that look at it.
        device: Warp device.
        monocular: frames have no depth.
    """

    config: TrackingConfig
    camera: Camera
    sensor_camera: Camera
    renderer: Renderer
    device: Any = "cpu"
    monocular: bool = False


TrackerFactory = Callable[[TrackerContext], Tracker]
"""Makes a tracker; it is called again where a new map begins."""

if TYPE_CHECKING:
    TrackerChoice = str | Tracker | TrackerFactory
else:
    TrackerChoice = str  # on the command line and in files a tracker is chosen by its name


@dataclass(frozen=True)
class TrackingConfig:
    """The tracker, and the options of all of them."""

    tracker: TrackerChoice = "hybrid"
    """How poses are found. gicp registers depth to the map's points; photometric looks for the pose at which
    the map looks like the picture; hybrid does the former, and aligns the picture to those taken on the way
    where that leaves the pose uncertain; ground-truth takes the data set's own."""
    loops: bool = True
    """Close loops: where a place is seen again, poses and the map are pulled together. With depth it needs a
    tracker that registers it, gicp or hybrid. Without depth views are also adjusted together on the way, so
    that their scale does not drift."""
    gicp: GicpConfig = field(default_factory=GicpConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    initialisation: InitialisationConfig = field(default_factory=InitialisationConfig)

    def __post_init__(self) -> None:
        """Refuse a tracker that there is not, by :class:`TrackerError`."""
        tracker_factory(self.tracker)


def _gicp(context: TrackerContext) -> Tracker:
    return GicpTracker(context.config.gicp, context.sensor_camera, device=context.device)


def _photometric(context: TrackerContext) -> Tracker:
    c = context.config
    if context.monocular:
        return MonocularTracker(c.refinement, c.initialisation, context.renderer, device=context.device)
    return PhotometricTracker(c.refinement, context.renderer, device=context.device)


def _hybrid(context: TrackerContext) -> Tracker:
    c = context.config
    return HybridTracker(c.gicp, context.camera, context.sensor_camera, device=context.device)


def _ground_truth(context: TrackerContext) -> Tracker:
    return GivenPoses(context.config.gicp, context.sensor_camera, device=context.device)


TRACKERS: dict[str, TrackerFactory] = {
    "gicp": _gicp,
    "photometric": _photometric,
    "hybrid": _hybrid,
    "ground-truth": _ground_truth,
}
"""Name -> what makes that tracker; :func:`register_tracker` adds to it."""


class TrackerError(ValueError):
    """What was given as a tracker is none."""


def register_tracker(name: str, factory: TrackerFactory) -> None:
    """Make a tracker known as ``name``, in configurations and on the command line.

    Raises:
        TrackerError: ``factory`` cannot be called.
    """
    TRACKERS[name] = tracker_factory(factory)


def tracker_factory(choice: TrackerChoice) -> TrackerFactory:
    """Return what makes the tracker ``choice``: a name, a factory, or a tracker, which is then started anew.

    Raises:
        TrackerError: there is no tracker of that name, or it is none of these.
    """
    names = ", ".join(TRACKERS)
    if isinstance(choice, str):
        if choice not in TRACKERS:
            raise TrackerError(f"{choice}: no such tracker; choose one of {names}")
        return TRACKERS[choice]
    if not isinstance(choice, type) and isinstance(choice, Tracker):
        return lambda context: choice
    if callable(choice):
        return choice
    raise TrackerError(
        f"{choice!r}: no tracker; give a name ({names}), an object with Tracker's methods, or a function "
        "that takes a TrackerContext and returns one"
    )


def make_tracker(context: TrackerContext) -> Tracker:
    """Return the tracker that ``context.config.tracker`` asks for."""
    return tracker_factory(context.config.tracker)(context)
