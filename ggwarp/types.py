# SPDX-License-Identifier: Apache-2.0
"""The values that pass between rooms: camera, frame, tracking result, map snapshot.

Frames: world and camera, OpenCV axes (x right, y down, z forward). Poses are named by
direction: ``T_wc`` takes camera coordinates to world coordinates. Units are metres and radians.
Pixel (0, 0) is the *centre* of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Frame:
    """One RGB-D image, with what else the data set knows of it.

    Attributes:
        index: the frame's index in the sequence.
        timestamp: seconds.
        rgb: [h, w, 3] uint8, RGB.
        depth: [h, w] float32, metres along the optical axis; 0 = no reading. None: monocular.
        mask: [h, w] int32 object ids as the data gives them; 0 = no object. None: no mask.
        T_wc: [4, 4] float64 true camera-to-world pose, when known. Never read by tracking.
        sensor_depth: [H, W] float32 metres, depth at the sensor's own resolution (tracking
            uses it whatever the image scale); None: same as ``depth``.
        depth_weight: [H, W] float32 of the size of ``sensor_depth``, or else of ``depth``: how much each
            reading counts, 0 to 1 for the surest; None: all alike.
        depth_timestamp: seconds, when the depth was taken; None: together with the colour.
        native_mask: [H, W] int32 ``mask`` at its own resolution, which objects are measured at; None: as
            ``mask``. For evaluation alone.
        true_mask: [H, W] int32 true object ids, where the data set knows them apart from ``mask``. For
            evaluation alone: never read by tracking or mapping.
    """

    index: int
    timestamp: float
    rgb: NDArray[np.uint8]
    depth: Float32 | None = None
    mask: NDArray[np.int32] | None = None
    T_wc: Float64 | None = None
    sensor_depth: Float32 | None = None
    depth_timestamp: float | None = None
    true_mask: NDArray[np.int32] | None = None
    native_mask: NDArray[np.int32] | None = None
    depth_weight: Float32 | None = None


@dataclass(frozen=True)
class StoredArray:
    """An array that is in a file, as part of a state: it is read when that is written elsewhere.

    Attributes:
        dtype, shape: of all of it.
        parts: reads it, part by part along its first axis.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    parts: Callable[[], Iterator[NDArray[Any]]]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        whole = np.concatenate([np.zeros((0, *self.shape[1:]), self.dtype), *self.parts()])
        return whole.astype(dtype or self.dtype, copy=False)


@dataclass(frozen=True)
class Exposure:
    """How a picture's colours, 0..1, come from those of the map: e^log_gain x + offset, by channel.

    Attributes:
        log_gain, offset: red, green, blue; 0 and 0 is the map's own exposure.
    """

    log_gain: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def uniform(cls, log_gain: float, offset: float) -> Exposure:
        """Return the exposure that treats all channels alike."""
        return cls((log_gain, log_gain, log_gain), (offset, offset, offset))

    def undo_exposure(self, rgb: NDArray[np.uint8]) -> Float32:
        """Return the map's colours [h, w, 3], 0..1, of the picture ``rgb`` [h, w, 3]."""
        slope, offset = np.exp(np.negative(self.log_gain)) / 255.0, np.array(self.offset)
        levels = np.arange(256)[:, None]  # a channel's 256 values are looked up, not computed anew
        colours = np.clip(levels * slope - offset * (slope * 255.0), 0.0, 1.0).astype(np.float32)
        return np.stack([colours[:, c][rgb[..., c]] for c in range(3)], axis=-1)


class Verdict(Enum):
    """What tracking says of a frame's pose."""

    CONVERGED = "converged"
    POOR = "poor"
    LOST = "lost"


@dataclass(frozen=True)
class FramePoints:
    """The points that a frame was tracked with, and how near the map's trackable points are.

    Attributes:
        points: [n, 3] float32 the frame's subsampled points, camera frame, metres.
        quats: [n, 4] float32 rotation of each point's ellipse, camera frame, w first.
        spreads: [n, 3] float32 standard deviations of the point itself on the ellipse's axes, metres:
            free along the surface, the sensor's noise across it. What trackable points keep.
        noise: [n] float32 standard deviation of each point's depth by the sensor's model, metres.
        distances2: [n] float32 squared distance to the nearest trackable Gaussian after
            registration, m^2; inf where none is within reach.
        noise_share: how much of ``noise`` the frame shows: 0 for rendered depth, near 1 for a
            structured-light sensor's.
    """

    points: Float32
    quats: Float32
    spreads: Float32
    noise: Float32
    distances2: Float32
    noise_share: float = 0.0

    @property
    def overlap(self) -> float:
        """Share of the points with a trackable Gaussian within reach; 0 where there are no points."""
        return overlap_of(self.distances2)

    @property
    def typical_noise(self) -> float:
        """Median standard deviation of depth as the frame shows it, metres; 0 where there are no points."""
        return self.noise_share * float(np.median(self.noise)) if len(self.noise) else 0.0

    @property
    def rmse(self) -> float:
        """Root mean square of the distances within reach, metres; 0 where there are none."""
        matched = self.distances2[np.isfinite(self.distances2)]
        return float(np.sqrt(matched.mean(dtype=np.float64))) if len(matched) else 0.0


def overlap_of(distances2: Float32) -> float:
    """Return the share of ``distances2`` [n] that are finite; 0 where there are none."""
    return int(np.count_nonzero(np.isfinite(distances2))) / max(len(distances2), 1)


@dataclass(frozen=True)
class TrackResult:
    """A frame's pose and how far to trust it.

    Attributes:
        T_wc: [4, 4] float64 camera-to-world.
        verdict: converged, poor (usable, but weak) or lost (``T_wc`` is a prediction).
        reason: one clause that says why, empty when converged.
        points: what the frame was tracked with; None: without points.
        exposure: of the picture, where tracking looked at it; None: not estimated.
        depth: [h, w] float32 metres, of the picture, where tracking estimated it without a sensor.
        overlap: share of the frame that the map explains: of its points, or of its pixels without points.
        information: [6, 6] inverse covariance of a twist (translation, rotation) in the camera; None: not
            stated.
        position_std: the position's largest standard deviation, metres, drift included; nan: not known.
        earlier_poses: index -> [4, 4] pose of earlier frames that became known only now.
        reinitialise: the map is not what the camera sees: a new one is to begin with the next frame. Only
            for trackers that look at the Gaussians.
    """

    T_wc: Float64
    verdict: Verdict
    reason: str = ""
    points: FramePoints | None = None
    exposure: Exposure | None = None
    depth: Float32 | None = None
    overlap: float = 0.0
    information: Float64 | None = None
    position_std: float = float("nan")
    earlier_poses: dict[int, Float64] = field(default_factory=dict)
    reinitialise: bool = False


@dataclass(frozen=True)
class MapSnapshot:
    """What the tracker sees of the map: its trackable Gaussians, world frame, unchanging.

    Attributes:
        version: grows by one with every change of the trackable set.
        means: [n] wp.vec3, metres.
        quats: [n] wp.vec4, w first, unit length.
        scales: [n] wp.vec3, standard deviations, metres.
    """

    version: int
    means: Any
    quats: Any
    scales: Any

    @property
    def count(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True)
class Rendered:
    """A view of the map, on the host.

    Attributes:
        rgb: [h, w, 3] float32 in 0..1 (clipped).
        depth: [h, w] float32 metres, expected depth (alpha-weighted, not normalised).
        median_depth: [h, w] float32 metres; 0 where the map is not opaque.
        opacity: [h, w] float32, accumulated alpha.
        identity: [h, w, 16] float32; None without identities.
        objects: [h, w] int32 object ids as the given masks name them, 0 = none; None without
            identities.
        classes: [h, w] int32 the likeliest class, as the identity classifier counts them, merged ones as
            one; None without identities.
        confidence: [h, w] float32, its probability, 0..1; None without identities.
    """

    rgb: Float32
    depth: Float32
    median_depth: Float32
    opacity: Float32
    identity: Float32 | None = None
    objects: NDArray[np.int32] | None = None
    classes: NDArray[np.int32] | None = None
    confidence: Float32 | None = None

    @property
    def surface_depth(self) -> Float32:
        """[h, w] metres: the expected depth of what is seen (sum w z / sum w); 0 where nothing is.

        Splats carry their depth to each pixel, so that this is nearer to the truth than the depth
        of the median splat: 1.0 against 1.15 cm on the built-in office.
        """
        seen = self.opacity > 0.0
        return np.divide(self.depth, self.opacity, out=np.zeros_like(self.depth), where=seen)


@dataclass(frozen=True)
class StepReport:
    """What one frame cost and gave: a row of ``frames.csv``.

    Attributes:
        index: the frame's index in the sequence.
        timestamp: seconds.
        T_wc: [4, 4] float64 the estimated (or predicted) pose.
        verdict, reason, overlap: see :class:`TrackResult`.
        rmse: see :class:`FramePoints`; 0 without points.
        depth_noise_mm: its ``typical_noise``, millimetres; 0 without points.
        position_std_cm: the position's largest standard deviation, drift included; nan where none is known.
        keyframe: "", "tracking" or "mapping".
        tracking_ms, mapping_ms: wall time, milliseconds.
        mapping_iterations: iterations spent during this frame.
        gaussians: Gaussians in the map afterwards.
        loss: mean mapping loss over this frame's iterations; nan when there was none.
        latency_ms: from the frame's arrival to its pose, milliseconds; but for live mode a frame arrives when
            the tracker takes it up.
        late_ms: how long after its arrival a busy system took the frame up, milliseconds (live mode).
        frames_behind: newer frames that had arrived by then.
        loop_ms: of ``tracking_ms``, spent on looking for loops and on closing them.
        loop_with: the earlier frame with which this one closed a loop; None: it closed none.
        loop_moved_cm: the farthest that anything was moved by that.
    """

    index: int
    timestamp: float
    T_wc: Float64
    verdict: Verdict
    reason: str
    overlap: float
    rmse: float
    keyframe: str
    tracking_ms: float
    mapping_ms: float
    mapping_iterations: int
    gaussians: int
    loss: float
    latency_ms: float = float("nan")
    depth_noise_mm: float = 0.0
    position_std_cm: float = float("nan")
    late_ms: float = 0.0
    frames_behind: int = 0
    loop_ms: float = 0.0
    loop_with: int | None = None
    loop_moved_cm: float | None = None
