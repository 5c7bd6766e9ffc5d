# SPDX-License-Identifier: Apache-2.0
"""The three-dimensional part of the page: splats, trajectories, keyframes, boxes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from ggwarp.geometry import se3
from ggwarp.geometry.boxes import OrientedBox
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import ObjectRecord
from ggwarp.results.scene_view import SceneView
from ggwarp.types import Float32, Float64

MAP, HELD = "/map", "/held"
FINAL, LIVE, LOOPS, KEYFRAMES = "/trajectory/final", "/trajectory/live", "/trajectory/loops", "/keyframes"
_FINAL_COLOUR, _LIVE_COLOUR, _LOOP_COLOUR = (255, 140, 0), (120, 160, 255), (230, 40, 160)
_SELECTED_COLOUR = (255, 140, 0)
_EDGES = np.array([(a, b) for a in range(8) for b in range(a) if (a ^ b).bit_count() == 1])


def show_splats(
    scene: viser.SceneApi,
    name: str,
    gaussians: Gaussians,
    colours: Float32,
    *,
    origin: ArrayLike = (0.0, 0.0, 0.0),
) -> None:
    """Show ``gaussians`` in ``colours`` [n, 3], 0..1, in place of what the name shows.

    Args:
        origin: [3] what their positions are relative to, metres, world frame.
    """
    if not len(gaussians):
        scene.remove_by_name(name)
        return
    values: dict[str, Any] = {
        "centers": gaussians.means - np.asarray(origin, np.float32),
        "covariances": covariances(gaussians),
        "rgbs": np.rint(255.0 * colours).astype(np.uint8),
        "opacities": _opacities(gaussians),
    }
    shown = scene.get_handle_by_name(name)
    if isinstance(shown, viser.GaussianSplatHandle):
        shown.set_gaussians(**values)
    else:
        scene.add_gaussian_splats(name, **values)


def covariances(gaussians: Gaussians) -> Float32:
    """Return [n, 3, 3] the covariances of ``gaussians``, square metres, world frame."""
    scaled = se3.matrices_from_quats(gaussians.quats) * np.exp(gaussians.log_scales)[:, None, :]
    return (scaled @ scaled.transpose(0, 2, 1)).astype(np.float32)


def _opacities(gaussians: Gaussians) -> Float32:
    return (1.0 / (1.0 + np.exp(-gaussians.opacity_logits.astype(np.float64))))[:, None].astype(np.float32)


def field_of_view(camera: Camera) -> float:
    """Return the vertical field of view of ``camera``, radians."""
    return 2.0 * math.atan(0.5 * camera.height / camera.fy)


def look_from(camera: viser.CameraHandle, T_wc: Float64, fov: float) -> None:
    """Have a client's camera look from ``T_wc`` [4, 4] with the vertical field of view ``fov``, radians."""
    camera.up_direction = -T_wc[:3, 1]
    camera.fov = fov
    camera.position = T_wc[:3, 3]
    camera.look_at = T_wc[:3, 3] + T_wc[:3, 2]


def begin_with(server: viser.ViserServer, view: SceneView, camera: Camera) -> None:
    """Have pages upright, and begin with ``view`` as ``camera`` sees it."""
    first = server.initial_camera
    server.scene.set_up_direction(view.up.direction)
    first.up = view.up.direction
    first.fov = field_of_view(camera)
    first.position = view.start[:3, 3]
    first.look_at = view.target


def add_path(
    scene: viser.SceneApi, name: str, points: Float64, colour: tuple[int, int, int], *, visible: bool = True
) -> None:
    """Draw a line through ``points`` [n, 3], metres; nothing where there are fewer than two."""
    if len(points) > 1:
        segments = np.stack([points[:-1], points[1:]], axis=1)
        _add_lines(scene, name, segments, colour, visible=visible)


def add_trajectories(
    scene: viser.SceneApi, final: Float64, live: Float64, loops: list[tuple[int, int]]
) -> None:
    """Draw the final trajectory [n, 4, 4], the one reported live [m, 4, 4] and the loops' edges.

    Args:
        loops: pairs of rows of ``final`` that a loop joined.
    """
    add_path(scene, FINAL, final[:, :3, 3], _FINAL_COLOUR)
    add_path(scene, LIVE, live[:, :3, 3], _LIVE_COLOUR, visible=False)
    if loops:
        _add_lines(scene, LOOPS, final[np.array(loops)][:, :, :3, 3], _LOOP_COLOUR)


def add_frustum(
    scene: viser.SceneApi,
    name: str,
    T_wc: Float64,
    camera: Camera,
    picture: NDArray[np.uint8] | None = None,
    *,
    size: float = 0.12,
    colour: tuple[int, int, int] = (90, 90, 90),
) -> viser.CameraFrustumHandle:
    """Draw a camera at ``T_wc`` [4, 4], with its ``picture`` [h, w, 3] where there is one.

    Args:
        size: metres from its centre to its picture.
    """
    return scene.add_camera_frustum(
        name,
        fov=field_of_view(camera),
        aspect=camera.width / camera.height,
        scale=size,
        thickness=1.5,
        thickness_units="screen",
        color=colour,
        image=picture,
        jpeg_quality=75,
        wxyz=se3.quat_from_matrix(T_wc[:3, :3]),
        position=T_wc[:3, 3],
    )


def add_box(scene: viser.SceneApi, name: str, box: OrientedBox) -> None:
    """Draw the edges of ``box``."""
    signs = np.array([[(k >> axis & 1) * 2 - 1 for axis in range(3)] for k in range(8)])
    corners = np.array(box.centre) + (signs * box.half_sizes) @ box.axes.T
    _add_lines(scene, name, corners[_EDGES], _SELECTED_COLOUR)


def _add_lines(
    scene: viser.SceneApi, name: str, segments: Float64, colour: tuple[int, int, int], *, visible: bool = True
) -> None:
    scene.add_line_segments(name, segments, colour, thickness=2.5, thickness_units="screen", visible=visible)


class Held:
    """An object that a gizmo moves."""

    def __init__(self, gizmo: viser.TransformControlsHandle, grip: Float64) -> None:
        self._gizmo, self._grip = gizmo, grip

    def motion(self) -> Float64:
        """Return [4, 4] how it is turned about its grip and shifted, metres."""
        T = np.eye(4)
        T[:3, :3] = se3.matrix_from_quat(self._gizmo.wxyz)
        T[:3, 3] = np.asarray(self._gizmo.position) - self._grip
        return T

    def shift(self, metres: ArrayLike) -> None:
        """Shift it by ``metres`` [3] along the world's axes."""
        self._gizmo.position = np.asarray(self._gizmo.position) + np.asarray(metres, np.float64)

    def remove(self) -> None:
        """Take it and the gizmo off the page."""
        self._gizmo.remove()


def hold(
    scene: viser.SceneApi, gaussians: Gaussians, colours: Float32, grip: Float64, record: ObjectRecord
) -> Held:
    """Show an object's ``gaussians`` in ``colours`` [n, 3] on a gizmo at ``grip`` [3], which moves them."""
    size = max(0.25, 1.2 * max(record.oriented_box.half_sizes))
    gizmo = scene.add_transform_controls(HELD, scale=size, position=grip, depth_test=False)
    show_splats(scene, f"{HELD}/splats", gaussians, colours, origin=grip)
    return Held(gizmo, grip)
