# SPDX-License-Identifier: Apache-2.0
"""Writers of small bags, of the room in ``recorded_scene``, through the libraries that others use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from recorded_scene import COLOUR, jpeg, look, millimetres, png, pose, quaternion

FRAMES = 3
DEPTH_CAMERA = Camera(64, 48, 55.0, 55.5, 31.0, 24.2)
COLOUR_FROM_DEPTH = se3.se3_exp([0.05, -0.01, 0.0, 0.0, 0.02, 0.0])


class _Messages:
    """Makes messages of either ROS."""

    def __init__(self, ros: int) -> None:
        self.ros = ros
        self.store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        if ros == 1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self._count = 0

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, stamp: float, frame: str) -> Any:
        self._count += 1
        time = self.make("builtin_interfaces/msg/Time", int(stamp), round(stamp % 1 * 1e9))
        first = (self._count,) if self.ros == 1 else ()
        return self.make("std_msgs/msg/Header", *first, time, frame)

    def image(self, stamp: float, frame: str, pixels: np.ndarray, encoding: str, *, padded: int = 0) -> Any:
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
        rows = np.pad(rows, ((0, 0), (0, padded)))
        height, step = rows.shape
        head = self.header(stamp, frame)
        values = (head, height, pixels.shape[1], encoding, 0, step, rows.ravel())
        return self.make("sensor_msgs/msg/Image", *values)

    def compressed(self, stamp: float, frame: str, kind: str, data: bytes) -> Any:
        name = "sensor_msgs/msg/CompressedImage"
        return self.make(name, self.header(stamp, frame), kind, np.frombuffer(data, np.uint8))

    def info(self, stamp: float, frame: str, camera: Camera) -> Any:
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        K = camera.matrix.ravel()
        P = np.hstack([camera.matrix, np.zeros((3, 1))]).ravel()
        head, none = self.header(stamp, frame), np.zeros(5)
        values = (head, camera.height, camera.width, "plumb_bob", none, K, np.eye(3).ravel(), P, 0, 0, region)
        return self.make("sensor_msgs/msg/CameraInfo", *values)

    def transform(self, T: np.ndarray) -> Any:
        at = self.make("geometry_msgs/msg/Vector3", *T[:3, 3].tolist())
        return self.make(
            "geometry_msgs/msg/Transform", at, self.make("geometry_msgs/msg/Quaternion", *quaternion(T))
        )

    def stamped(self, stamp: float, parent: str, child: str, T: np.ndarray) -> Any:
        name = "geometry_msgs/msg/TransformStamped"
        return self.make(name, self.header(stamp, parent), child, self.transform(T))

    def pack(self, message: Any) -> bytes:
        pack = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
        return bytes(pack(message, message.__msgtype__))


def _recording(
    m: _Messages, *, registered: bool, compressed: bool, start: float
) -> list[tuple[str, float, Any]]:
    """Return (topic, time, message) of a recording; depth comes 4 ms later than colour."""
    found: list[tuple[str, float, Any]] = []
    frame = "camera_color_optical_frame"
    depth_frame = frame if registered else "camera_depth_optical_frame"
    depth_topic = "/camera/aligned_depth_to_color/image_raw" if registered else "/camera/depth/image_rect_raw"
    tree = m.make(
        "tf2_msgs/msg/TFMessage",
        [
            m.stamped(
                start, "camera_link", "/camera_depth_optical_frame", se3.se3_exp([0.1, 0, 0, 0.3, 0, 0])
            ),
            m.stamped(
                start,
                "camera_link",
                frame,
                se3.se3_exp([0.1, 0, 0, 0.3, 0, 0]) @ se3.inverse(COLOUR_FROM_DEPTH),
            ),
        ],
    )
    found.append(("/tf_static", start, tree))
    for i in range(FRAMES):
        t = start + i / 30
        rgb, later = look(COLOUR, pose(i))[0], pose(i + 0.004 * 30)
        depth = look(COLOUR, later)[1] if registered else look(DEPTH_CAMERA, later @ COLOUR_FROM_DEPTH)[1]
        found.append(("/camera/color/camera_info", t, m.info(t, frame, COLOUR)))
        info = m.info(t, depth_frame, COLOUR if registered else DEPTH_CAMERA)
        found.append((f"{depth_topic.rsplit('/', 1)[0]}/camera_info", t, info))
        if compressed:
            picture = m.compressed(t, frame, "rgb8; jpeg compressed bgr8", jpeg(rgb))
            found.append(("/camera/color/image_raw/compressed", t, picture))
            raw = bytes(12) + png(millimetres(depth))
            packed = m.compressed(t + 0.004, depth_frame, "16UC1; compressedDepth", raw)
            found.append((f"{depth_topic}/compressedDepth", t + 0.004, packed))
        else:
            picture = m.image(t, frame, np.ascontiguousarray(rgb[..., ::-1]), "bgr8", padded=6)
            found.append(("/camera/color/image_raw", t, picture))
            image = millimetres(depth) if registered else depth
            kind = "16UC1" if registered else "32FC1"
            found.append((depth_topic, t + 0.004, m.image(t + 0.004, depth_frame, image, kind)))
        found.append(("/vicon/camera/ground_truth", t, m.stamped(t, "world", "camera", pose(i))))
    found.append(
        ("/camera/infra1/image_raw", start, m.image(start, "x", np.zeros((4, 6), np.uint8), "mono8"))
    )
    return found


def ros1(path: Path, **how: bool) -> Path:
    m = _Messages(1)
    _write1(path, m, _recording(m, start=1.7e9, **how))
    return path


def _write1(path: Path, m: _Messages, messages: list[tuple[str, float, Any]]) -> None:
    path.unlink(missing_ok=True)
    with Writer1(path) as writer:
        places = {}
        for topic, t, message in messages:
            if topic not in places:
                places[topic] = writer.add_connection(topic, message.__msgtype__, typestore=m.store)
            writer.write(places[topic], round(t * 1e9) + 1000, m.pack(message))


def ros2(path: Path, *, storage: str = "sqlite3", **how: bool) -> Path:
    m = _Messages(2)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        places = {}
        for topic, t, message in _recording(m, start=1.7e9, **how):
            if topic not in places:
                places[topic] = writer.add_connection(topic, message.__msgtype__, typestore=m.store)
            writer.write(places[topic], round(t * 1e9) + 1000, m.pack(message))
    return path


def mcap(path: Path, **how: bool) -> Path:
    m = _Messages(2)
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for topic, t, message in _recording(m, start=1.7e9, **how):
            name = message.__msgtype__
            if topic not in channels:
                text, _ = m.store.generate_msgdef(name, ros_version=2)
                schema = writer.register_schema(name=name, encoding="ros2msg", data=text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            at = round(t * 1e9)
            writer.add_message(channels[topic], log_time=at, publish_time=at, data=m.pack(message))
        writer.finish()
    return path


def realsense(path: Path) -> Path:
    """Write what RealSense's recorder does, in the topics that it uses."""
    m = _Messages(1)
    sensor = "/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"
    # Points of the reference, which is the depth, to each stream.
    found: list[tuple[str, float, Any]] = [
        ("/device_0/sensor_0/option/Depth_Units/value", 1.0, m.make("std_msgs/msg/Float32", 0.0001)),
        (f"{sensor[0]}/tf/0", 1.0, m.transform(np.eye(4))),
        (f"{sensor[1]}/tf/0", 1.0, m.transform(COLOUR_FROM_DEPTH)),
        (f"{sensor[0]}/info/camera_info", 1.0, m.info(0.0, "0", DEPTH_CAMERA)),
        (f"{sensor[1]}/info/camera_info", 1.0, m.info(0.0, "0", COLOUR)),
    ]
    for i in range(FRAMES):
        t = 10.0 + i / 30
        depth = look(DEPTH_CAMERA, pose(i) @ COLOUR_FROM_DEPTH)[1]
        raw = np.rint(depth * 10000).astype(np.uint16)
        found.append((f"{sensor[0]}/image/data", t, m.image(t, "0", raw, "mono16")))
        found.append((f"{sensor[1]}/image/data", t, m.image(t, "1", look(COLOUR, pose(i))[0], "rgb8")))
        found.append(("/mocap/truth", t, m.stamped(t, "world", "camera", pose(i))))
    _write1(path, m, found)
    return path
