# SPDX-License-Identifier: Apache-2.0
"""A small room that any camera can look at, and whether a data set tells the truth about it.

The room is rendered ray by ray in NumPy, so that depth is exact in every camera, of whatever size and place.
"""

from __future__ import annotations

import cv2
import numpy as np

from ggwarp.datasets import Dataset
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera

COLOUR = Camera(80, 60, 65.0, 66.0, 40.2, 29.4)
"""A colour camera with 4:3 pictures; depth is ``COLOUR.resized(40, 30)`` where a phone would make it."""
_WALLS = ((0, 1.8), (0, -1.6), (1, 1.2), (1, -1.1), (2, 2.6), (2, -2.0))
_BEGIN = se3.se3_exp([0, 0, 0, 0, 0.43, 0]) @ se3.se3_exp([0, 0, 0, -0.34, 0, 0])
_BEGIN[:3, 3] = -0.9, -0.4, -0.6
_BOX = np.array([[-0.5, 0.1], [0.2, 0.9], [1.3, 1.8]])


def pose(i: float) -> np.ndarray:
    """Return the camera-to-world pose of frame ``i``: some way round and up, a few degrees at a time.

    It looks down into a corner, so that three walls and the box hold it in every direction.
    """
    return _BEGIN @ se3.se3_exp([0.04 * i, -0.02 * i, 0.03 * i, 0.02 * i, -0.05 * i, 0.03 * i])


def look(camera: Camera, T_wc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return colour [h, w, 3] uint8 RGB and depth [h, w] float32, metres, as seen from ``T_wc``."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    rays, origin = camera.rays(u, v) @ T_wc[:3, :3].T, T_wc[:3, 3]
    depth = np.full(u.shape, np.inf)
    for axis, at in _WALLS:
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (at - origin[axis]) / rays[..., axis]
        depth = np.where((distance > 0) & (distance < depth), distance, depth)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (_BOX - origin[:, None])[:, None, None, :] / np.moveaxis(rays, -1, 0)[..., None]
    near, far = ends.min(axis=-1).max(axis=0), ends.max(axis=-1).min(axis=0)
    depth = np.where((near < far) & (near > 0) & (near < depth), near, depth)
    points = origin + depth[..., None] * rays
    waves = 127.0 + 60.0 * np.sin(points * [5.0, 6.0, 7.0] + [0.3, 1.1, 2.0])
    return (waves + 40.0 * np.sin(4.0 * points[..., ::-1])).clip(0, 255).astype(np.uint8), depth.astype(
        np.float32
    )


def millimetres(depth: np.ndarray) -> np.ndarray:
    return np.rint(depth * 1000).astype(np.uint16)


def png(image: np.ndarray) -> bytes:
    """Return a PNG file of grey, depth, or RGB."""
    return cv2.imencode(".png", image if image.ndim == 2 else image[..., ::-1])[1].tobytes()


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()


def check_truth(dataset: Dataset, *, tolerance: float = 0.02, colour: float = 12.0) -> None:
    """Check that frames, poses and camera fit each other: points of a frame, seen in the next, lie there.

    A wrong unit, axis, order of a quaternion, inverse, intrinsic or pairing shows as a large error.

    Args:
        tolerance: of the median error of depth, metres.
        colour: of the median difference of colours, of 255.
    """
    camera = dataset.camera
    for i in range(len(dataset) - 1):
        one, other = dataset[i], dataset[i + 1]
        assert one.rgb.shape == other.rgb.shape == (camera.height, camera.width, 3)
        assert one.depth is not None and other.depth is not None and one.depth.shape == one.rgb.shape[:2]
        assert one.T_wc is not None and other.T_wc is not None
        assert np.linalg.norm(se3.se3_log(se3.inverse(one.T_wc) @ other.T_wc)) > 0.02, "the camera moves"
        rows, columns = np.nonzero(one.depth > 0)
        assert len(rows) > 0.5 * one.depth.size
        points = camera.back_project(columns, rows, one.depth[rows, columns].astype(np.float64))
        T = se3.inverse(other.T_wc) @ one.T_wc
        points = points @ T[:3, :3].T + T[:3, 3]
        at_rows, at_columns, seen = camera.pixels_of(points)
        there = other.depth[at_rows, at_columns]
        seen &= there > 0
        assert seen.mean() > 0.5
        assert np.median(np.abs(there - points[:, 2])[seen]) < tolerance
        difference = one.rgb[rows, columns].astype(float) - other.rgb[at_rows, at_columns]
        assert np.median(np.abs(difference)[seen]) < colour
        assert other.timestamp > one.timestamp


def gl(T_wc: np.ndarray) -> np.ndarray:
    """Return a pose with the camera's axes of OpenGL and ARKit: y up, z back."""
    return T_wc @ np.diag([1.0, -1.0, -1.0, 1.0])


def quaternion(T: np.ndarray) -> list[float]:
    """Return x y z w."""
    w, x, y, z = se3.quat_from_matrix(T[:3, :3]).tolist()
    return [x, y, z, w]
