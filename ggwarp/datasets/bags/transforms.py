# SPDX-License-Identifier: Apache-2.0
"""Where cameras are: static transforms of ROS, and what RealSense's recorder writes in their stead."""

from __future__ import annotations

from typing import Any

import numpy as np

from ggwarp.datasets.bags.files import Bag
from ggwarp.datasets.poses import pose_from_quaternion
from ggwarp.geometry import se3
from ggwarp.types import Float64


def pose_of(transform: Any) -> Float64 | None:
    """Return the motion [4, 4] of a geometry_msgs Transform or Pose; None where it is none."""
    at = getattr(transform, "translation", None) or transform.position
    turn = getattr(transform, "rotation", None) or transform.orientation
    return pose_from_quaternion((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))


def static_transforms(bag: Bag) -> dict[str, tuple[str, Float64]]:
    """Return frame -> its parent and the motion [4, 4] that takes points of the frame to the parent's."""
    found: dict[str, tuple[str, Float64]] = {}
    for topic, kind in bag.types.items():
        if not (topic.endswith("tf_static") and kind.endswith("TFMessage")):
            continue
        for _, message in bag.all(topic):
            for stamped in message.transforms:
                T = pose_of(stamped.transform)
                if T is not None:
                    found[_frame(stamped.child_frame_id)] = (_frame(stamped.header.frame_id), T)
    return found


def between(transforms: dict[str, tuple[str, Float64]], target: str, source: str) -> Float64 | None:
    """Return what takes points of the frame ``source`` to ``target`` [4, 4]; None: nothing joins them."""
    one, other = (_to_ancestors(transforms, _frame(name)) for name in (target, source))
    common = next((name for name in other if name in one), None)
    return None if common is None else se3.inverse(one[common]) @ other[common]


def _to_ancestors(transforms: dict[str, tuple[str, Float64]], name: str) -> dict[str, Float64]:
    """Return ancestor -> what takes points of ``name`` there, itself first; a circle is gone round once."""
    T, found = np.eye(4), {}
    while name not in found:
        found[name] = T
        if name in transforms:
            name, step = transforms[name]
            T = step @ T
    return found


def _frame(name: str) -> str:
    return str(name).lstrip("/")


def realsense_motion(bag: Bag, depth_topic: str, colour_topic: str) -> Float64 | None:
    """Return what takes points of depth to colour [4, 4] of a RealSense recording; None: nothing says.

    Beside ``.../Depth_0/image/data`` lies ``.../Depth_0/tf/N``: what takes points of reference N there.
    """
    motions: list[dict[str, Float64]] = []
    for name in (colour_topic, depth_topic):
        stem = name.rsplit("/image/", 1)[0]
        told = {
            topic.rsplit("/", 1)[1]: pose_of(bag.first(topic))
            for topic, kind in bag.types.items()
            if topic.startswith(f"{stem}/tf/") and kind.endswith("/Transform")
        }
        motions.append({reference: T for reference, T in told.items() if T is not None})
    colour, depth = motions
    reference = next((name for name in depth if name in colour), None)
    return None if reference is None else colour[reference] @ se3.inverse(depth[reference])
