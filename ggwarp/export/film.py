# SPDX-License-Identifier: Apache-2.0
"""Short films of the map: animated WebP, which browsers and chats play."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ggwarp.editing.device import ready_device
from ggwarp.editing.inpaint.planes import surface_normals
from ggwarp.editing.map_view import MapView
from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.geometry.boxes import axis_aligned_box, main_parts
from ggwarp.io.atomic import atomic_write
from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float32, Float64

_MOST_FRAMES = 300  # 20 seconds
_FRAME_MS = 67
_QUALITY = 70
_TURN = 120  # pictures of a full turn, 8 seconds
_ELEVATION = np.radians(35.0)
_NEIGHBOURS = 16  # whose surface a Gaussian lies on
_ROOM = 1.1  # times their size that Gaussians have in the picture
_LOOKED_AT = 5000  # Gaussians, for the distance
_SHOWN = 99.5  # percent of them that the picture holds at least


def write_film(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write the film along the run's path, 20 seconds at most; of an object, with nothing else."""
    step = max(options.every, -(-len(scene.poses) // _MOST_FRAMES))
    view = MapView(scene.gaussians, scene.run.camera, device=ready_device(options.device))
    _write(path, [view.render(T_wc).rgb for T_wc in scene.poses[::step]])


def write_orbit(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write a film of one turn about the map, or about objects, from above.

    Walls do not hide the room: of the whole map that is shown whose seen side faces the viewer.
    """
    device, camera = ready_device(options.device), scene.run.camera
    gaussians = scene.gaussians.take(main_parts(scene.gaussians.means))
    inwards = seen_sides(gaussians, scene.poses) if scene.whole else None
    pictures = []
    for T_wc in orbit(gaussians, scene, inwards)[:: options.every]:
        shown = gaussians
        if inwards is not None:
            towards = T_wc[:3, 3] - gaussians.means
            shown = gaussians.take((towards * inwards).sum(axis=1) > 0.0)
        pictures.append(MapView(shown, camera, device=device).render(T_wc).rgb)
    _write(path, pictures)


def seen_sides(gaussians: Gaussians, poses: Float64) -> Float32:
    """Return [n, 3] unit normals towards the nearest of ``poses`` [m, 4, 4], from which each was seen."""
    from scipy.spatial import KDTree

    normals, means = surface_normals(gaussians), gaussians.means
    nearest = poses[KDTree(poses[:, :3, 3]).query(means)[1], :3, 3]
    away = ((nearest - means) * normals).sum(axis=1) < 0.0
    sides = np.where(away[:, None], -normals, normals)
    # A Gaussian alone may lean or be as thick as wide; its neighbours lie on the same surface.
    around = KDTree(means).query(means, k=min(_NEIGHBOURS, len(means)))[1].reshape(len(means), -1)
    mean = sides[around].mean(axis=1)
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-6)


def orbit(gaussians: Gaussians, scene: ExportScene, sides: Float32 | None = None) -> list[Float64]:
    """Return [4, 4] poses that turn once about ``gaussians`` and see them whole.

    Args:
        sides: [n, 3] of Gaussians that need be seen from there alone (:func:`seen_sides`); None: all.
    """
    box = axis_aligned_box(gaussians.means, gaussians.extents())
    centre = 0.5 * (np.array(box.low) + np.array(box.high))
    some = slice(None, None, -(-len(gaussians) // _LOOKED_AT))
    points = _ROOM * (gaussians.means[some] - centre)
    camera, up = scene.run.camera, scene.up
    slopes = 0.5 * np.array([camera.width / camera.fx, camera.height / camera.fy])
    ahead = scene.poses[0, :3, 2] - (scene.poses[0, :3, 2] @ up) * up
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    turns, distance = [], 1e-3
    for angle in np.linspace(0.0, 2.0 * np.pi, _TURN, endpoint=False):
        level = np.cos(angle) * ahead + np.sin(angle) * right
        forward = np.cos(_ELEVATION) * level - np.sin(_ELEVATION) * up
        x = np.cross(level, up)
        turns.append(np.stack([x, np.cross(forward, x), forward], axis=1))
        local = points if sides is None else points[sides[some] @ forward < 0.0]
        if len(local):
            local = local @ turns[-1]
            needed = (np.abs(local[:, :2]) / slopes).max(axis=1) - local[:, 2]
            distance = max(distance, float(np.percentile(needed, _SHOWN)))
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    for T_wc, turn in zip(poses, turns, strict=True):
        T_wc[:3, :3], T_wc[:3, 3] = turn, centre - distance * turn[:, 2]
    return list(poses)


def _write(path: Path, pictures: Sequence[Float32]) -> None:
    """Write pictures [h, w, 3] in 0..1 as an animated WebP."""
    from PIL import Image

    frames = [Image.fromarray(np.rint(255.0 * rgb).astype(np.uint8)) for rgb in pictures]
    with atomic_write(path) as file:
        frames[0].save(
            file,
            "WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=_FRAME_MS,
            loop=0,
            quality=_QUALITY,
        )
