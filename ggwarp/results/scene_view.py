# SPDX-License-Identifier: Apache-2.0
"""``view.json``: which way is up in a map, and where to look at it from first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.upright import Up, estimate_up, given_up, levelled, rotation_to
from ggwarp.io.camera import finite_number
from ggwarp.io.guarded import CAMERA, FileError, read_json
from ggwarp.io.json import write_json
from ggwarp.io.printable import printable, shown
from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float64

FILE = "view.json"

_MOST_POSES, _MOST_GAUSSIANS = 200, 20_000  # looked at in search of a first view
_SAMPLES, _NEIGHBOURS = 6000, 32  # of the surface
_SOURCES = ("surfaces", "camera", "given")


@dataclass(frozen=True)
class SceneView:
    """How a map is shown: upright, and from where first.

    Attributes:
        up: away from the floor.
        start: [4, 4] camera-to-world pose of the first view, level, on the run's path.
        target: [3] what that view looks at, metres, world frame; what to turn about.
    """

    up: Up
    start: Float64
    target: Float64

    def rotation_to(self, convention: str) -> Float64:
        """Return [3, 3] from the world to one of :data:`ggwarp.geometry.upright.CONVENTIONS`.

        What the first view looks at is then ahead.
        """
        return rotation_to(convention, self.up.direction, self.start[:3, 2])


def describe_view(gaussians: Gaussians, camera: Camera, T_wc: Float64, up: Up | None = None) -> SceneView:
    """Return how to show a map.

    Args:
        gaussians: the map.
        camera: of the run's images.
        T_wc: [n, 4, 4] the run's poses, n > 0.
        up: where it is known; None: it is estimated.
    """
    up = up or estimate_up(T_wc, *_surfaces(gaussians))
    some = gaussians.means[:: max(1, len(gaussians) // _MOST_GAUSSIANS)]
    poses = [levelled(pose, up.direction) for pose in T_wc[:: max(1, len(T_wc) // _MOST_POSES)]]
    inside = [_in_view(camera, pose, some) for pose in poses]
    # Most of the map, but not looking down at the floor or up at the ceiling.
    level = [np.sqrt(1.0 - (pose[:3, 2] @ up.direction) ** 2) for pose in poses]
    shown = [len(depths) * weight for depths, weight in zip(inside, level, strict=True)]
    best = int(np.argmax(shown))
    depth = float(np.median(inside[best])) if len(inside[best]) else 1.0
    return SceneView(up, poses[best], poses[best][:3, 3] + depth * poses[best][:3, 2])


def write_view(folder: Path, view: SceneView) -> None:
    """Write ``view.json``; lengths to 0.1 mm."""
    values = {
        "up": view.up.direction.round(6).tolist(),
        "up_source": view.up.source,
        "up_support": None if view.up.support is None else round(view.up.support, 4),
        "start": view.start.round(6).tolist(),
        "target": view.target.round(4).tolist(),
    }
    write_json(folder / FILE, values)


def read_view(folder: Path) -> SceneView:
    """Read what :func:`write_view` wrote.

    Raises:
        FileError: the file cannot be read, or is none.
    """
    path = folder / FILE
    values = read_json(path, CAMERA)
    if not isinstance(values, dict):
        values = {}
    up, start, target = (
        _numbers(values.get(key), shape, f"{printable(str(path))}: {key}")
        for key, shape in (("up", (3,)), ("start", (4, 4)), ("target", (3,)))
    )
    source = values.get("up_source")
    rotation = start[:3, :3]
    if source not in _SOURCES or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise FileError(f"{printable(str(path))}: is no view of a map; remove it, and it is estimated anew")
    try:
        direction = given_up(up).direction
    except ValueError as error:
        raise FileError(f"{printable(str(path))}: {error}") from None
    return SceneView(Up(direction, source, finite_number(values.get("up_support"))), start, target)


def parse_up(text: str) -> Up | None:
    """Return the direction that ``--up`` names: x, -y, ..., or three numbers; None for auto.

    Raises:
        ValueError: it is none of them.
    """
    if text == "auto":
        return None
    axis = text.removeprefix("-")
    if axis in ("x", "y", "z"):
        return given_up(np.eye(3)["xyz".index(axis)] * (1.0 if axis == text else -1.0))
    try:
        return given_up([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        raise ValueError(
            f"--up {shown(text)}: give auto, x, -x, y, -y, z, -z, or three numbers such as 0,0,1"
        ) from None


def joined_up(arguments: list[str]) -> list[str]:
    """Return ``arguments`` with ``--up -y`` as ``--up=-y``; argparse takes -y for an option."""
    out: list[str] = []
    for word in arguments:
        if out and out[-1] == "--up":
            out[-1] = f"--up={word}"
        else:
            out.append(word)
    return out


def _numbers(value: object, shape: tuple[int, ...], what: str) -> Float64:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise FileError(f"{what} is {shown(value)}; remove the file, and it is estimated anew")
    return array


def _surfaces(gaussians: Gaussians) -> tuple[Float64, Float64]:
    """Return the normals [m, 3] of a map's surface at some of its Gaussians, and how much each counts, [m].

    They are of planes through neighbours: a Gaussian's own shape is fitted to colours, too. What is no plane
    counts little; sparse places, where neighbours are far apart, no more than dense ones.
    """
    from scipy.spatial import KDTree  # heavy, and only needed once a map is described

    points = np.asarray(gaussians.means[gaussians.opacity_logits > 0.0], np.float64)
    if len(points) < _NEIGHBOURS:
        return np.zeros((0, 3)), np.zeros(0)
    some = points[:: -(-len(points) // _SAMPLES)]
    distances, rows = KDTree(points).query(some, k=_NEIGHBOURS)
    near = points[rows] - points[rows].mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near) / _NEIGHBOURS)
    thickness = np.sqrt(np.maximum(variances[:, 0], 0.0) / np.maximum(variances[:, 1], 1e-12))
    areas = distances[:, -1] ** 2
    return axes[:, :, 0], np.minimum(areas, np.percentile(areas, 75)) * np.clip(0.5 - thickness, 0.0, 1.0)


def _in_view(camera: Camera, T_wc: Float64, points: np.ndarray) -> np.ndarray:
    """Return the depths, metres, of those of ``points`` [n, 3] that a picture from ``T_wc`` may show."""
    local = se3.transform_points(se3.inverse(T_wc), points)
    return local[camera.pixels_of(local)[2], 2]
