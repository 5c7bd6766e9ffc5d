# SPDX-License-Identifier: Apache-2.0
"""The trackers there are, and how one is built."""

from __future__ import annotations

from typing import Any, Literal, Protocol

from ggwarp.geometry.camera import Camera
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.tracking.gicp import GicpConfig, GicpTracker
from ggwarp.pipeline.tracking.given_poses import GivenPoses
from ggwarp.pipeline.tracking.hybrid import HybridConfig, HybridTracker
from ggwarp.pipeline.tracking.initialisation import InitialisationConfig
from ggwarp.pipeline.tracking.monocular import MonocularTracker
from ggwarp.pipeline.tracking.photometric import PhotometricConfig, PhotometricTracker
from ggwarp.types import Float64, Frame, MapSnapshot, TrackResult

TrackerKind = Literal["gicp", "photometric", "hybrid", "ground-truth"]


class Tracker(Protocol):
    """Finds each frame's pose; one that looks at the Gaussians says so by ``needs_gaussians = True``."""

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        """Take the first frame, whose pose [4, 4] is given."""
        ...

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        """Return the pose of the next frame."""
        ...

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """Take note that the last frame's pose [4, 4] was corrected by the mapper."""
        ...


def make_tracker(
    kind: TrackerKind,
    *,
    gicp: GicpConfig,
    photometric: PhotometricConfig,
    hybrid: HybridConfig,
    sensor_camera: Camera,
    renderer: Renderer,
    initialisation: InitialisationConfig | None = None,
    device: Any,
) -> Tracker:
    """Return a tracker of frames with colour by the renderer's camera and depth by ``sensor_camera``.

    Args:
        renderer: of the map that is being built; for those that look at it.
    """
    if initialisation is not None:
        return MonocularTracker(photometric, initialisation, renderer, device=device)
    if kind == "photometric":
        return PhotometricTracker(photometric, renderer, device=device)
    if kind == "hybrid":
        return HybridTracker(hybrid, gicp, sensor_camera, renderer, device=device)
    tracker = GivenPoses if kind == "ground-truth" else GicpTracker
    return tracker(gicp, sensor_camera, device=device)
