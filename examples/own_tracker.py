# SPDX-License-Identifier: Apache-2.0
"""A tracker of one's own: poses come from a robot's odometry; registered, it has a name like the others.

python examples/own_tracker.py
"""

import numpy as np

from ggwarp import Frame, FrameReader, Slam, SlamConfig, SyntheticOffice, TrackResult
from ggwarp.pipeline.tracking.gicp import GicpTracker
from ggwarp.pipeline.tracking.tracker import TrackerContext, register_tracker
from ggwarp.types import Float64, MapSnapshot


def odometry(frame: Frame) -> Float64:
    """What the robot says: camera to world [4, 4]; here the true pose, a millimetre off."""
    assert frame.T_wc is not None
    T_wc = frame.T_wc.copy()
    T_wc[:3, 3] += np.random.default_rng(frame.index).normal(scale=0.001, size=3)
    return T_wc


class OdometryTracker:
    """Believes the odometry, and measures how much of the frame lies on the map there."""

    needs_gaussians = False  # so that it may run while the mapper does

    def __init__(self, context: TrackerContext) -> None:
        # The parts of other trackers can be used: here the points of a frame and their overlap.
        self._points = GicpTracker(context.config.gicp, context.sensor_camera, device=context.device)

    def start(self, frame: Frame, T_wc: Float64) -> TrackResult:
        return self._points.start(frame, T_wc)

    def track(self, frame: Frame, target: MapSnapshot) -> TrackResult:
        return self._points.place(frame, target, odometry(frame))

    def on_pose_corrected(self, T_wc: Float64) -> None:
        self._points.on_pose_corrected(T_wc)


def main(frames: int = 10, scale: float = 0.2) -> None:
    # From here on `SlamConfig(tracker="odometry")` is a choice like "gicp"; a class or function does, too.
    register_tracker("odometry", OdometryTracker)
    dataset = SyntheticOffice(frames=120, scale=scale)
    with FrameReader(dataset, range(frames), scale=1.0) as reader:
        slam = Slam(SlamConfig(tracker="odometry"), reader.camera, reader.sensor_camera, device="cpu")
        for frame in reader:
            report = slam.step(frame)
            error = np.linalg.norm(report.T_wc[:3, 3] - dataset[report.index].T_wc[:3, 3])
            print(f"frame {report.index}: {report.verdict.value}, {1e3 * error:.1f} mm off")


if __name__ == "__main__":
    main()
