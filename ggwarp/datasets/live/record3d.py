# SPDX-License-Identifier: Apache-2.0
"""An iPhone or iPad on a cable: ``--seq record3d:``, the USB stream of the Record3D app, by its own library.

Behind the colon may stand the beginning of the device's identifier (UDID). Colour, depth in metres and its
confidence, intrinsics of the colour picture and ARKit's pose come with every frame.
"""

from __future__ import annotations

import atexit
import queue
import threading
import time
from typing import Any, NamedTuple

import numpy as np

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import metres, size_of, weighted
from ggwarp.datasets.live.sequence import LivePicture, LiveSequence, Newest
from ggwarp.datasets.poses import opencv_axes, pose_from_quaternion
from ggwarp.geometry.camera import Camera
from ggwarp.io.printable import printable

PATIENCE_S = 30.0
"""How long the first picture may take, for which the app's button is pressed."""
_SILENCE_S = 5.0
"""How long no picture may come before the stream has ended."""
_MILLIMETRES = 1000.0


class _Arrival(NamedTuple):
    """What the library holds when a frame has come, copied."""

    time: float
    rgb: Any
    depth: Any
    confidence: Any
    K: Any
    pose: Any


def open_record3d(which: str) -> LiveSequence:
    """Open the stream of a device: colour, and the smaller depth that shows the same view.

    Args:
        which: how its identifier begins; empty: the first device.

    Raises:
        DatasetError: the library is not installed, there is no such device, or the app does not send.
    """
    name = f"--seq record3d:{printable(which)}"
    try:
        from record3d import Record3DStream
    except ImportError as error:
        raise DatasetError(
            f"{name}: needs record3d; pip install 'ggwarp[record3d]' ({printable(str(error))})"
        ) from None
    devices = list(Record3DStream.get_connected_devices())
    device = next((found for found in devices if found.udid.startswith(which)), None)
    if device is None:
        there = (
            ", ".join(printable(found.udid) for found in devices) or "none; plug it in, unlock it, trust this"
        )
        raise DatasetError(f"{name}: there is no such device (found: {there})")
    arrived: queue.SimpleQueue[_Arrival | None] = queue.SimpleQueue()
    session, stopped, started = Record3DStream(), threading.Event(), time.monotonic()

    def on_new_frame() -> None:
        """Copy the frame, in the library's thread: once this returns, the next one overwrites it."""
        parts = session.get_rgb_frame(), session.get_depth_frame(), session.get_confidence_frame()
        arrived.put(
            _Arrival(
                time.monotonic() - started, *parts, session.get_intrinsic_mat(), session.get_camera_pose()
            )
        )

    def on_stream_stopped() -> None:
        stopped.set()
        arrived.put(None)

    session.on_new_frame, session.on_stream_stopped = on_new_frame, on_stream_stopped
    remedy = "open Record3D on it, switch on USB Streaming mode in its settings, and press the record button"
    if not session.connect(device):
        raise DatasetError(f"{name}: the device does not answer; {remedy}")

    def close() -> None:
        """Let the library's thread end: after Python has, it must not call back."""
        if not stopped.is_set():
            session.disconnect()

    atexit.register(close)
    first = _next(arrived, PATIENCE_S)
    if first is None:
        close()
        raise DatasetError(f"{name}: no picture came within {PATIENCE_S:g} s; {remedy}")

    def take() -> LivePicture | None:
        arrival = _next(arrived, _SILENCE_S)
        return None if arrival is None else _picture(arrival)

    newest = Newest(take)
    calibration = Calibration(_camera(first), _MILLIMETRES, origin="the device", scale_origin="the device")
    return LiveSequence(
        "record3d",
        newest,
        calibration,
        has_depth=True,
        layout=f"Record3D's USB stream of {printable(device.udid)}",
        dropped=lambda: newest.dropped,
    )


def _next(arrived: queue.SimpleQueue[_Arrival | None], seconds: float) -> _Arrival | None:
    """Return the next frame; None where the stream has ended, or nothing comes in time."""
    try:
        return arrived.get(timeout=seconds)
    except queue.Empty:
        return None


def _camera(arrival: _Arrival) -> Camera:
    width, height = size_of(arrival.rgb)
    K = arrival.K
    return Camera(width, height, float(K.fx), float(K.fy), float(K.tx), float(K.ty))


def _picture(arrival: _Arrival) -> LivePicture:
    pose, depth, weight = arrival.pose, metres(np.asarray(arrival.depth)), None
    if np.shape(arrival.confidence) == depth.shape:
        depth, weight = weighted(depth, np.asarray(arrival.confidence))
    T_wc = pose_from_quaternion((pose.tx, pose.ty, pose.tz), (pose.qx, pose.qy, pose.qz, pose.qw))
    rgb = np.asarray(arrival.rgb, np.uint8)
    return LivePicture(arrival.time, rgb, depth, opencv_axes(T_wc), weight, _camera(arrival))
