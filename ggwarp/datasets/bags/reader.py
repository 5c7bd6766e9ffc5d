# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags, ROS 2 bags and MCAP files, RealSense's ``.bag`` and ``.db3`` among them.

The topic of depth (aligned to colour where there is such a one), that of colour with the most pictures, and
their CameraInfo are found by what they hold and by their names. Pictures are paired by the times of their
headers. Where depth is by another camera it is registered by ``/tf_static``, or by what RealSense writes.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.datasets.bags.files import Bag, Stamp, open_bag
from ggwarp.datasets.bags.pictures import MILLIMETRES, colour_of, depth_of, is_depth, lens_of
from ggwarp.datasets.bags.transforms import between, pose_of, realsense_motion, static_transforms
from ggwarp.datasets.base import DatasetError, Kind, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.pairing import pair_times
from ggwarp.datasets.readers.tum import interpolated
from ggwarp.datasets.rig import Lens
from ggwarp.datasets.sequence import Entry, FileSequence, Picture
from ggwarp.datasets.source import Source
from ggwarp.io.printable import printable
from ggwarp.types import Float64

_PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO = "sensor_msgs/msg/CameraInfo"
_REGISTERED = re.compile(r"aligned|registered|depth_to_color|depth_to_rgb", re.IGNORECASE)
_TRUTH = re.compile(r"truth|(^|[/_])gt([/_]|$)|vicon|mocap|optitrack|qualisys", re.IGNORECASE)
_POSES = ("Odometry", "PoseStamped", "TransformStamped", "PoseWithCovarianceStamped")
_DEPTH_UNITS = "/option/Depth_Units/value"
_SAME_PLACE = 1e-6


def recognises(path: Path) -> bool:
    """Return whether ``path`` is the folder of a ROS 2 bag."""
    return (path / "metadata.yaml").is_file() and any((*path.glob("*.db3"), *path.glob("*.mcap")))


def open_sequence(path: Path, masks: Masks = None) -> FileSequence:
    """Open a bag; reads it once for the times of its pictures.

    Raises:
        DatasetError: the library is missing, the bag is damaged, or has no colour with a CameraInfo.
    """
    bag = open_bag(path)
    colour, depth, others = _topics(bag)
    stamps = bag.stamps(colour)
    info = _info(bag, colour)
    lens, scale = lens_of(bag.first(info), f"{path}: {printable(info)}"), MILLIMETRES
    calibration, unit, notes = Calibration(lens.camera, scale, lens.distortion), "", []
    partners, depth_stamps, pairing = [-1] * len(stamps), [], ""
    if depth is not None:
        scale, unit = _unit(bag, depth)
        calibration, notes = _calibration(bag, colour, depth, lens, path)
        depth_stamps = bag.stamps(depth)
        paired = pair_times(_made(stamps), _made(depth_stamps))
        partners, pairing = paired.partners, paired.summary("colour pictures", "depth pictures")
        notes += paired.notes
    poses, truth = _truth(bag, _made(stamps))
    entries = []
    for stamp, partner, T_wc in zip(stamps, partners, poses, strict=True):
        rgb = _picture(bag, colour, stamp, colour_of)
        metric, taken = None, None
        if depth is not None and partner >= 0:
            taken = depth_stamps[partner].made
            metric = _picture(bag, depth, depth_stamps[partner], partial(depth_of, scale=scale))
        entries.append(Entry(rgb, metric, stamp.made, T_wc, taken))
    source = Source(
        layout=f"a bag, {printable(colour)}" + (f" and {printable(depth)}" if depth else ""),
        pairing=pairing,
        camera=printable(info),
        depth_unit=unit,
        truth=truth,
        notes=tuple(notes),
        unread=tuple(printable(topic) for topic in others),
    )
    return FileSequence(path, "bag", entries, calibration, masks=masks, source=source)


def _made(stamps: list[Stamp]) -> Float64:
    return np.array([stamp.made for stamp in stamps])


def _picture(bag: Bag, topic: str, stamp: Stamp, convert: Callable[[Any, Path], Any]) -> Picture:
    name = bag.path / topic.strip("/") / str(stamp.recorded)
    return Picture(name, lambda: convert(bag.message(topic, stamp.recorded), name))


def _topics(bag: Bag) -> tuple[str, str | None, list[str]]:
    """Return the topics of colour and depth that are read, and those of pictures that are not."""
    found: dict[bool, list[str]] = {True: [], False: []}
    pictures = [t for t, kind in bag.types.items() if kind in _PICTURES and bag.counts[t]]
    for topic in sorted(pictures):
        kind = is_depth(bag.first(topic))
        if kind is not None:
            found[kind].append(topic)
    if not found[False]:
        shown = ", ".join(map(printable, sorted(bag.types)[:8])) or "none"
        raise DatasetError(f"{bag.path}: holds no colour pictures (topics: {shown})")

    def rank(topic: str) -> tuple[bool, bool, int, str]:
        named = re.search(r"colou?r|rgb", topic, re.IGNORECASE) is not None
        return bool(_REGISTERED.search(topic)), named, bag.counts[topic], topic

    colour = max(found[False], key=lambda topic: rank(topic)[1:])
    depth = max(found[True], key=rank, default=None)
    return colour, depth, [topic for topic in pictures if topic not in (colour, depth)]


def _info(bag: Bag, topic: str) -> str:
    """Return the CameraInfo topic whose name is nearest to that of pictures."""
    infos = [t for t, kind in bag.types.items() if kind == _INFO and bag.counts[t]]
    if not infos:
        raise DatasetError(
            f"{bag.path}: has no CameraInfo for {printable(topic)}; record it with the pictures"
        )
    return max(infos, key=lambda info: (_shared(info, topic), -len(info), info))


def _shared(topic: str, other: str) -> int:
    """Return how many parts of their names two topics have in common from the start on."""
    same = [one == two for one, two in zip(topic.split("/"), other.split("/"), strict=False)]
    return same.index(False) if False in same else len(same)


def _unit(bag: Bag, depth: str) -> tuple[float, str]:
    """Return what a metre counts in whole numbers of depth, and who says so."""
    sensor = re.match(r".*/sensor_\d+/", depth)
    for topic in bag.types:
        if sensor and topic.endswith(_DEPTH_UNITS) and topic.startswith(sensor[0]):
            metres = _number(bag.first(topic).data)
            if metres > 0.0:
                return 1.0 / metres, f"{1.0 / metres:g} units a metre, from {printable(topic)}"
    return MILLIMETRES, "millimetres, or metres in floating point, as ROS has them"


def _number(value: object) -> float:
    """Return a message's number, which newer recordings write as text; 0 where it is none."""
    try:
        number = float(str(value))
    except ValueError:
        return 0.0
    return number if np.isfinite(number) else 0.0


def _calibration(
    bag: Bag, colour_topic: str, depth_topic: str, colour: Lens, path: Path
) -> tuple[Calibration, list[str]]:
    """Return how depth is brought to colour, and what is doubtful about it."""
    plain = Calibration(colour.camera, MILLIMETRES, colour.distortion)
    if _REGISTERED.search(depth_topic):
        return plain, []
    info = _info(bag, depth_topic)
    if info == _info(bag, colour_topic):
        return plain, []
    messages = bag.first(_info(bag, colour_topic)), bag.first(info)
    lens = lens_of(messages[1], f"{path}: {printable(info)}")
    frames = [str(message.header.frame_id) for message in messages]
    T = realsense_motion(bag, depth_topic, colour_topic)
    if T is None and frames[0] and frames[0] == frames[1]:
        T = np.eye(4)
    if T is None:
        T = between(static_transforms(bag), frames[0], frames[1])
    notes = []
    if T is None:
        notes = [
            f"nothing says where the depth camera ({printable(frames[1])}) is to the colour camera "
            f"({printable(frames[0])}): taken to be the same place; record /tf_static"
        ]
    elif _size(T) < _SAME_PLACE:
        T = None
    if T is None and lens == colour:
        return plain, notes
    return Calibration(colour.camera, MILLIMETRES, colour.distortion, lens, T), notes


def _size(T: Float64) -> float:
    """Return the largest entry by which a motion [4, 4] differs from none."""
    return float(np.abs(T - np.eye(4)).max())


def _truth(bag: Bag, stamps: Float64) -> tuple[list[Float64 | None], str]:
    """Return the pose at each of ``stamps`` out of a topic that is named as truth, and where from."""
    topics = [
        t for t, kind in bag.types.items() if kind.endswith(_POSES) and _TRUTH.search(t) and bag.counts[t]
    ]
    if not topics:
        return [None] * len(stamps), ""
    topic = max(topics, key=lambda name: (bag.counts[name], name))
    times, poses = [], []
    for recorded, message in bag.all(topic):
        stamp = message.header.stamp
        made = float(getattr(stamp, "sec", 0)) + 1e-9 * float(getattr(stamp, "nanosec", 0))
        held = getattr(message, "transform", None) or message.pose
        poses.append(pose_of(getattr(held, "pose", held)))
        times.append(made if made > 1.0 else recorded * 1e-9)
    found = interpolated(stamps, np.array(times), poses)
    known = sum(pose is not None for pose in found)
    return found, f"{printable(topic)}, poses of {known} of {len(stamps)} pictures, of its own frame"


KIND = Kind(
    "bag",
    "ROS bags: .bag, .mcap, .db3, or a folder with metadata.yaml",
    recognises,
    open_sequence,
    suffixes=(".bag", ".mcap", ".db3"),
)
