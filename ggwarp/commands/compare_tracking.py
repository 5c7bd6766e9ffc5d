# SPDX-License-Identifier: Apache-2.0
"""Compare our tracking with small_gicp's on the same points and the same map policy.

    ggwarp compare-tracking office0_kf livingroom1 --data ~/data

Three rows a sequence: ours; small_gicp's GICP at its best (constant velocity, 10 cm then 3 cm); and
with GS-ICP-SLAM's settings (from the previous pose, 2 cm). ATE is the RMSE after SE(3) alignment; ms
is a frame's time from points to pose, without reading files.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.datasets import DatasetError, open_dataset
from ggwarp.evaluation.trajectory import absolute_error
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.io.printable import printable
from ggwarp.pipeline.tracking.gicp import OVERLAP_DISTANCE, REACH, GicpConfig, GicpTracker
from ggwarp.pipeline.tracking.keyframe_policy import KeyframeConfig, KeyframeKind, OverlapKeyframes
from ggwarp.pipeline.tracking.point_map import TrackableConfig, TrackableMap
from ggwarp.pipeline.tracking.preprocess import observe
from ggwarp.pipeline.tracking.tracker import Tracker
from ggwarp.runtime import launch, loading
from ggwarp.types import Float64, Frame, FramePoints, MapSnapshot, TrackResult, Verdict

try:
    import small_gicp
except ImportError:  # the command says what to install
    small_gicp: Any = None


@dataclass(frozen=True)
class PeerSettings:
    """How small_gicp is used."""

    radii: tuple[float, ...]
    constant_velocity: bool
    rotation_epsilon: float
    translation_epsilon: float


USER_ERROR = 2

BEST = PeerSettings((0.1, 0.03), True, 1e-5, 1e-5)
GS_ICP = PeerSettings((0.02,), False, 2e-3, 5e-4)


class PeerTracker:
    """small_gicp behind our tracker's interface."""

    needs_gaussians = False

    def __init__(self, settings: PeerSettings, config: GicpConfig, camera: Camera) -> None:
        self._settings = settings
        self._config = config
        self._camera = camera
        self._poses: list[Float64] = []
        self._version: int | None = None
        self._cloud: Any = None
        self._tree: Any = None
        self.seconds = 0.0
        """What the peer's own work on the last frame took."""

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        return self._result(frame, None, lambda _: T_wc)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        return self._result(frame, target, self._align)

    def on_pose_corrected(self, T_wc: Float64) -> None:
        """Nothing here corrects poses."""

    def _align(self, points: Any) -> Float64:
        s = self._settings
        T = self._poses[-1]
        if s.constant_velocity and len(self._poses) > 1:
            T = T @ se3.inverse(self._poses[-2]) @ T
        cloud, _ = _prepared(points)
        for radius in s.radii:
            T = small_gicp.align(
                self._cloud,
                cloud,
                self._tree,
                T,
                max_correspondence_distance=radius,
                num_threads=launch.cpu_threads(),
                max_iterations=64,
                rotation_epsilon=s.rotation_epsilon,
                translation_epsilon=s.translation_epsilon,
            ).T_target_source
        return se3.orthonormalised(T)

    def _result(
        self, frame: Frame, target: MapSnapshot | None, pose_of: Callable[[Any], Float64]
    ) -> TrackResult:
        image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
        assert image is not None
        seen = observe(image, self._camera, self._config, device="cpu")
        points = seen.cloud.points.numpy()
        # Our sampling stands in for the peer's own: its time is not counted.
        started = time.perf_counter()
        if target is not None and target.version != self._version:
            self._cloud, self._tree = _prepared(target.means.numpy())
            self._version = target.version
        T = pose_of(points)
        self._poses.append(T)
        distances2 = np.full(len(points), np.inf)
        if target is not None:
            found, d2 = self._tree.batch_nearest_neighbor_search(
                se3.transform_points(T, points), launch.cpu_threads()
            )
            reach = max(OVERLAP_DISTANCE, REACH * seen.spacing)
            distances2 = np.where((np.array(found) >= 0) & (np.array(d2) < reach**2), d2, np.inf)
        self.seconds = time.perf_counter() - started
        observed = FramePoints(
            points=points,
            quats=seen.quats.numpy(),
            spreads=seen.spreads.numpy(),
            noise=seen.noise,
            distances2=distances2.astype(np.float32),
            noise_share=seen.noise_share,
        )
        return TrackResult(T, Verdict.CONVERGED, points=observed, overlap=observed.overlap)


def _prepared(points: Any) -> tuple[Any, Any]:
    cloud = small_gicp.PointCloud(np.asarray(points, np.float64))
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_covariances(cloud, tree, 10, launch.cpu_threads())
    return cloud, tree


def run(tracker: Tracker, dataset: Any) -> tuple[float, float, int]:
    """Return ATE RMSE in cm, median ms a frame, and frames lost."""
    trackable = TrackableMap(TrackableConfig())
    policy = OverlapKeyframes(KeyframeConfig())
    estimated, true, times, lost = [], [], [], 0
    for index in range(len(dataset)):
        frame = dataset[index]
        started = time.perf_counter()
        if index == 0:
            result = tracker.start(frame, frame.T_wc)
        else:
            result = tracker.track(frame, trackable.snapshot())
        seconds = time.perf_counter() - started
        times.append(tracker.seconds if isinstance(tracker, PeerTracker) else seconds)
        if policy.decide(result) is KeyframeKind.TRACKING:
            trackable.add(result.points, result.T_wc)
        lost += result.verdict is Verdict.LOST
        if frame.T_wc is not None:
            estimated.append(result.T_wc)
            true.append(frame.T_wc)
    error = absolute_error(np.array(estimated), np.array(true))
    return 100.0 * error.rmse, 1e3 * float(np.median(times)), lost


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(
        prog="ggwarp compare-tracking", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("sequences", nargs="+", help="names under the data root, or folders")
    parser.add_argument("--data", type=Path, help="data root (default: $GGWARP_DATA, else ./data)")
    parser.add_argument("--threads", type=int, default=launch.cpu_threads(), help="threads of each")
    options = parser.parse_args(arguments)
    if small_gicp is None:
        print("ggwarp compare-tracking: small_gicp is not installed: pip install small_gicp", file=sys.stderr)
        return USER_ERROR
    root = options.data or Path(os.environ.get("GGWARP_DATA") or "data")
    loading.init_quietly()
    launch.set_cpu_threads(options.threads)
    config = GicpConfig()
    print(f"{'sequence':28} {'tracker':22} {'ATE cm':>8} {'ms':>7} {'lost':>5}")
    for name in options.sequences:
        try:
            dataset = open_dataset(name, data_root=root, masks="none")
        except DatasetError as error:
            print(f"ggwarp compare-tracking: {printable(str(error))}", file=sys.stderr)
            return USER_ERROR
        trackers = {
            "ggwarp": GicpTracker(config, dataset.camera),
            "small_gicp, best": PeerTracker(BEST, config, dataset.camera),
            "small_gicp, GS-ICP": PeerTracker(GS_ICP, config, dataset.camera),
        }
        for label, tracker in trackers.items():
            ate, ms, lost = run(tracker, dataset)
            shown = "" if isinstance(tracker, PeerTracker) else str(lost)
            print(f"{printable(dataset.name):28} {label:22} {ate:8.4f} {ms:7.1f} {shown:>5}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
