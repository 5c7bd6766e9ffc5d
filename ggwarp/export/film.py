# SPDX-License-Identifier: Apache-2.0
"""Short films of the map: animated WebP, which browsers and chats play."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ggwarp.editing.device import ready_device
from ggwarp.editing.inpaint.planes import surface_normals
from ggwarp.editing.map_view import MapView
from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.geometry.boxes import main_parts
from ggwarp.io.atomic import atomic_write
from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float32, Float64

_MOST_FRAMES = 300  # 20 seconds
_FRAME_MS = 67
_QUALITY = 70
_TURN = 120  # pictures of a full turn, 8 seconds
_ELEVATION = np.radians(35.0)
_TRIM = 2.0  # percent of the Gaussians at either end that an orbit need not show


def write_film(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write the film along the run's path, 20 seconds at most; of an object, with nothing else before black."""
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
    for T_wc in list(orbit(gaussians, scene))[:: options.every]:
        shown = gaussians
        if inwards is not None:
            towards = T_wc[:3, 3] - gaussians.means
            shown = gaussians.take((towards * inwards).sum(axis=1) > 0.0)
        pictures.append(MapView(shown, camera, device=device).render(T_wc).rgb)
    _write(path, pictures)


def seen_sides(gaussians: Gaussians, poses: Float64) -> Float32:
    """Return [n, 3] unit normals that point to the nearest of ``poses`` [m, 4, 4], from which each was seen."""
    from scipy.spatial import KDTree

    normals = surface_normals(gaussians)
    nearest = poses[KDTree(poses[:, :3, 3]).query(gaussians.means)[1], :3, 3]
    away = ((nearest - gaussians.means) * normals).sum(axis=1) < 0.0
    return np.where(away[:, None], -normals, normals)


def orbit(gaussians: Gaussians, scene: ExportScene) -> Iterator[Float64]:
    """Yield [4, 4] poses that turn once about ``gaussians`` and see them whole."""
    low, high = np.percentile(gaussians.means, [_TRIM, 100.0 - _TRIM], axis=0)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    camera, up = scene.run.camera, scene.up
    narrow = np.arctan(0.5 * min(camera.width / camera.fx, camera.height / camera.fy))
    distance = max(radius, 1e-3) / np.sin(narrow)
    ahead = scene.poses[0, :3, 2] - (scene.poses[0, :3, 2] @ up) * up
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    for angle in np.linspace(0.0, 2.0 * np.pi, _TURN, endpoint=False):
        level = np.cos(angle) * ahead + np.sin(angle) * right
        forward = np.cos(_ELEVATION) * level - np.sin(_ELEVATION) * up
        x = np.cross(level, up)
        T_wc = np.eye(4)
        T_wc[:3, :3] = np.stack([x, np.cross(forward, x), forward], axis=1)
        T_wc[:3, 3] = centre - distance * forward
        yield T_wc


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
