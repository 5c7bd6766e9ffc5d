# SPDX-License-Identifier: Apache-2.0
"""Cameras that are plugged in: ``--seq webcam:0`` by OpenCV, ``--seq realsense:`` by pyrealsense2.

Behind the colon stands the number of a webcam, the serial number of a RealSense camera (the first if empty),
or a file that is played as if it were one.
"""

from __future__ import annotations

import atexit
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.calibration import Calibration, Intrinsics, given_camera
from ggwarp.datasets.images import size_of
from ggwarp.datasets.live.sequence import LivePicture, LiveSequence, Newest
from ggwarp.datasets.rig import Lens
from ggwarp.geometry.camera import Camera
from ggwarp.io.printable import printable
from ggwarp.types import Float64

_PATIENCE_MS = 5000
"""How long a RealSense camera may be silent."""
_INTERVAL_MS = 200
_PLAIN = ("brown_conrady", "modified_brown_conrady", "inverse_brown_conrady", "none")


def open_webcam(which: str, intrinsics: Intrinsics | None) -> LiveSequence:
    """Open a webcam: colour alone.

    Args:
        which: its number, or a video file.

    Raises:
        DatasetError: there is none such, it gives no picture, or its camera is not given.
    """
    name = f"webcam:{printable(which)}"
    if not (which.isascii() and which.isdigit() and len(which) < 4) and not Path(which).is_file():
        raise DatasetError(f"--seq {name}: expected a number, such as webcam:0, or a video file")
    capture = cv2.VideoCapture()
    opened = capture.open(int(which)) if which.isdigit() else capture.open(str(Path(which).absolute()))
    good, first = capture.read() if opened else (False, None)
    if not good or first is None:
        raise DatasetError(f"--seq {name}: there is no such camera, or it gives no picture")
    camera = given_camera(Path(name), size_of(first), intrinsics)
    started = time.monotonic()

    def take() -> LivePicture | None:
        good, image = capture.read()
        if not good or image is None:
            return None
        rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
        return LivePicture(time.monotonic() - started, rgb)

    newest = Newest(take)
    calibration = Calibration(camera, 1000.0, origin="--intrinsics")
    return LiveSequence(
        "webcam", newest, calibration, has_depth=False, layout=name, dropped=lambda: newest.dropped
    )


def open_realsense(which: str) -> LiveSequence:
    """Open a RealSense camera: colour, and depth registered to it.

    Args:
        which: its serial number, a recording, or empty: the first camera.

    Raises:
        DatasetError: pyrealsense2 is not installed, there is no such camera, or it gives no pictures.
    """
    name = f"realsense:{printable(which)}"
    try:
        import pyrealsense2  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise DatasetError(
            f"--seq {name}: needs pyrealsense2; pip install 'ggwarp[realsense]' ({printable(str(error))})"
        ) from None
    rs: Any = pyrealsense2
    pipeline, config = rs.pipeline(), rs.config()
    try:
        if Path(which).is_file():  # its streams are what was recorded
            config.enable_device_from_file(which, repeat_playback=False)
        else:
            if which:
                config.enable_device(which)
            config.enable_stream(rs.stream.depth, rs.format.z16)
            config.enable_stream(rs.stream.color, rs.format.rgb8)
        profile = pipeline.start(config)
        calibration = _calibration(profile, rs, name)
    except RuntimeError as error:
        raise DatasetError(f"--seq {name}: {printable(str(error).splitlines()[0])}") from None
    ending = threading.Event()
    scale = np.float32(1.0 / calibration.depth_scale)

    def take() -> LivePicture | None:
        for _ in range(_PATIENCE_MS // _INTERVAL_MS):
            if ending.is_set():
                return None
            good, frames = pipeline.try_wait_for_frames(_INTERVAL_MS)
            if not good:
                continue
            colour, depth = frames.get_color_frame(), frames.get_depth_frame()
            if colour and depth:
                raw = np.asanyarray(depth.get_data())
                rgb = np.array(colour.get_data(), np.uint8)
                return LivePicture(frames.get_timestamp() / 1000.0, rgb, raw.astype(np.float32) * scale)

        return None

    newest = Newest(take)

    def close() -> None:
        """Stop the camera: its own threads do not end with the program."""
        ending.set()
        newest.thread.join(2.0)
        pipeline.stop()

    atexit.register(close)
    return LiveSequence(
        "realsense", newest, calibration, has_depth=True, layout=name, dropped=lambda: newest.dropped
    )


def _calibration(profile: Any, rs: Any, name: str) -> Calibration:
    colour, depth = (
        profile.get_stream(kind).as_video_stream_profile() for kind in (rs.stream.color, rs.stream.depth)
    )
    lenses = [_lens(stream.get_intrinsics(), name) for stream in (colour, depth)]
    unit = float(profile.get_device().first_depth_sensor().get_depth_scale())
    return Calibration(
        lenses[0].camera,
        1.0 / unit,
        lenses[0].distortion,
        lenses[1],
        _motion(depth.get_extrinsics_to(colour)),
        origin="the camera",
        scale_origin="the camera",
    )


def _lens(values: Any, name: str) -> Lens:
    camera = Camera(values.width, values.height, values.fx, values.fy, values.ppx, values.ppy)
    coefficients = tuple(map(float, values.coeffs))
    model = str(values.model).rsplit(".", 1)[-1]
    if any(coefficients) and model not in _PLAIN:
        raise DatasetError(f"--seq {name}: its lens, {model}, is not read")
    return Lens(camera, coefficients if any(coefficients) else ())


def _motion(extrinsics: Any) -> Float64:
    """Return RealSense's extrinsics, whose rotation is by columns, as [4, 4]."""
    T = np.eye(4)
    T[:3, :3] = np.reshape(extrinsics.rotation, (3, 3)).T
    T[:3, 3] = extrinsics.translation
    return T
