# SPDX-License-Identifier: Apache-2.0
"""The built-in scenes as data sets: rendered on the fly, with exact truth."""

from __future__ import annotations

import copy
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.built_in.faults import MaskFaults, SensorFaults, faulty_colour, faulty_depth, faulty_mask
from ggwarp.datasets.built_in.lighting import baked_lights
from ggwarp.datasets.built_in.office import office_scene
from ggwarp.datasets.built_in.scene import Scene, Shape, device_arrays, in_view, looking, primitive_rows
from ggwarp.datasets.built_in.wall import wall_scene, wall_trajectory
from ggwarp.datasets.source import Source
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.scene import raycast
from ggwarp.types import Float32, Float64, Frame

REPLICA_CAMERA = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5)
FRAME_RATE = 30.0
_BYTE: Any = wp.uint8
_lock = threading.Lock()

_BARE_VIEW = (1.35, 1.20, 1.40)


class SyntheticScene:
    """A scene of analytic primitives, rendered on the fly along a trajectory.

    Frames carry exact z-depth at pixel centres, the ids of :attr:`class_names` at every pixel (structure
    included; faults are the mask's alone, not the true mask's) and the true pose. A frame depends on its
    index and the options alone. Indexing is safe from several threads at once.
    """

    kind = "synthetic"
    source = Source("a built-in scene", depth_unit="metres, rendered", truth="the rendered camera's poses")
    masks_text = "rendered"
    has_depth = True
    has_masks = True

    def __init__(
        self,
        name: str,
        scene: Scene,
        trajectory: Float64,
        *,
        camera: Camera = REPLICA_CAMERA,
        scale: float = 1.0,
        faults: SensorFaults = SensorFaults(),  # noqa: B008 - frozen
        mask_faults: MaskFaults = MaskFaults(),  # noqa: B008 - frozen
        without: tuple[int, ...] = (),
        shade_goes: bool = False,
        device: Any = "cpu",
    ) -> None:
        """Lay the scene out; its light is baked with the first frame (half a second).

        Args:
            trajectory: [frames, 4, 4] camera-to-world poses.
            camera: what sees it; Replica's, unless said.
            scale: of the camera's size; frames are rendered at that size.
            faults: of the camera.
            mask_faults: of the object masks.
            without: ids of objects left out; what remains keeps its look, their shadows
                included, as in a map from which they were taken.
            shade_goes: their shadows go, too.
            device: the Warp device that renders.

        Raises:
            DatasetError: no frames, a scale out of (0, 4], or an unknown id.
        """
        if not len(trajectory):
            raise DatasetError(f"{name}: 0 frames; at least 1 is needed")
        if not 0.0 < scale <= 4.0:
            raise DatasetError(f"{name}: scale {scale}; it must lie in (0, 4]")
        self.class_names = scene.names
        unknown = sorted(set(without) - set(self.class_names))
        if unknown:
            raise DatasetError(f"{name}: without {unknown}; objects are 1 to {len(self.class_names)}")
        self.name = name
        self.camera = camera.scaled(scale)
        self.faults = faults
        self.mask_faults = mask_faults
        self.trajectory = trajectory
        self.ids = np.array(sorted(set(self.class_names) - set(without)), np.int32)
        rows, balls = primitive_rows(scene.shapes)
        kept = ~np.isin(rows["object_id"], without)
        self._rows, self._balls = rows[kept], balls[kept]
        self._scene = self._shading = scene
        if shade_goes:
            self._shading = replace(scene, shapes=[s for s in scene.shapes if s.object_id not in without])
        self._device = device

    def __len__(self) -> int:
        return len(self.trajectory)

    @property
    def stems(self) -> list[str]:
        """Each frame's name, as its mask has it in a folder of masks."""
        return [f"frame{index:06d}" for index in range(len(self))]

    def scaled(self, scale: float) -> SyntheticScene:
        """Return the same scene seen by a camera of ``scale`` times the size."""
        other = copy.copy(self)
        other.camera = self.camera.scaled(scale)
        return other

    def __getitem__(self, index: int) -> Frame:
        """Return frame ``index``, rendered now."""
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}")
        T_wc = self.trajectory[index]
        rgb, depth, mask = self.render(T_wc, self._moving(index))
        return Frame(
            index=index,
            timestamp=index / FRAME_RATE,
            rgb=faulty_colour(rgb, self.faults, index, index / max(1, len(self) - 1)),
            depth=self._sensed(depth, index),
            mask=faulty_mask(mask, self.mask_faults, index, self.ids),
            T_wc=T_wc.copy(),
            true_mask=mask,
        )

    def _moving(self, index: int) -> list[Shape]:
        """Return what stands in the scene in frame ``index`` alone."""
        return []

    def _sensed(self, depth: Float32, index: int) -> Float32:
        """Return the depth [h, w] of frame ``index`` as the sensor measures it, metres."""
        return faulty_depth(depth, self.faults, index, self.camera)

    def render(
        self, T_wc: Float64, moving: Sequence[Shape] = ()
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what a faultless camera sees from ``T_wc`` [4, 4].

        Args:
            T_wc: camera-to-world.
            moving: shapes that stand there now, lit by the rooms but without shadows.

        Returns:
            rgb [h, w, 3] uint8, depth [h, w] float32 metres, ids [h, w] int32; 0 where nothing is.
        """
        device = wp.get_device(self._device)
        with _lock:
            lights, _ = baked_lights(self._shading, str(device))
        rows, balls = self._rows, self._balls
        if moving:
            more = primitive_rows(list(moving), first=len(self._scene.shapes))
            rows, balls = np.concatenate([rows, more[0]]), np.concatenate([balls, more[1]])
        seen = in_view(balls, self.camera, T_wc)
        primitives, bounds = device_arrays(rows[seen], balls[seen], device=device)
        w, h = self.camera.width, self.camera.height
        tiles = -(-w // raycast.TILE) * -(-h // raycast.TILE)
        count = primitives.shape[0]
        depth = wp.empty((h, w), dtype=float, device=device)
        objects = wp.empty((h, w), dtype=int, device=device)
        colour = wp.empty((h, w, 3), dtype=_BYTE, device=device)
        raycast.render(
            primitives,
            bounds,
            lights,
            intrinsics_of(self.camera),
            wp.mat44(*np.asarray(T_wc, np.float32).ravel().tolist()),
            lists=wp.empty((tiles, count), dtype=int, device=device),
            starts=wp.empty((tiles, count), dtype=float, device=device),
            counts=wp.empty(tiles, dtype=int, device=device),
            faces=wp.empty((h, w), dtype=int, device=device),
            depth=depth,
            objects=objects,
            colour=colour,
            device=device,
        )
        return colour.numpy().copy(), depth.numpy().copy(), objects.numpy().copy()


class SyntheticOffice(SyntheticScene):
    """A room of 5.0 x 4.0 x 2.7 m with 48 objects, seen along one loop that ends where it began."""

    def __init__(self, *, frames: int = 120, featureless_wall: bool = False, **options: Any) -> None:
        """Lay the office out.

        Args:
            frames: frames along the loop; the last one's pose is the first one's.
            featureless_wall: adds a stretch where one bare wall fills the view.
            options: see :class:`SyntheticScene`.
        """
        trajectory = loop_trajectory(frames, featureless_wall=featureless_wall) if frames > 0 else np.empty(0)
        super().__init__("office", office_scene(featureless_wall), trajectory, **options)


class SyntheticWall(SyntheticScene):
    """One textured plane and nothing else, along which depth images slide freely."""

    def __init__(self, *, frames: int = 60, **options: Any) -> None:
        """Lay the wall out.

        Args:
            frames: frames of the camera's swaying.
            options: see :class:`SyntheticScene`.
        """
        super().__init__("wall", wall_scene(), wall_trajectory(frames), **options)


def loop_trajectory(frames: int, *, featureless_wall: bool = False) -> Float64:
    """Return [frames, 4, 4] camera-to-world poses along one loop, evenly paced, last = first.

    Pace counts 3.5 cm and 3.5 degrees alike. With 120 frames a step is at most 4 cm and 4
    degrees; the walk to the bare wall makes that 8 cm.
    """
    dense = np.stack([_pose(t, featureless_wall) for t in np.linspace(0.0, 1.0, 1441)])
    moved = np.linalg.norm(np.diff(dense[:, :3, 3], axis=0), axis=1) / 0.035
    cosine = 0.5 * (np.einsum("nij,nij->n", dense[1:, :3, :3], dense[:-1, :3, :3]) - 1.0)
    turned = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) / 3.5
    pace = np.concatenate([[0.0], np.cumsum(np.hypot(moved, turned))])
    times = np.interp(np.linspace(0.0, pace[-1], frames), pace, np.linspace(0.0, 1.0, 1441))
    return np.stack([_pose(t, featureless_wall) for t in times])


def _pose(time: float, featureless_wall: bool) -> Float64:
    """Camera-to-world at ``time`` 0..1: on an ellipse, looking across the room, swaying a little."""
    a = 2.0 * np.pi * (time - np.floor(time))
    position = np.array([0.70 * np.cos(a), 0.50 * np.sin(a), 1.40 + 0.08 * np.sin(2.0 * a + 0.5)])
    heading = a + np.pi + np.radians(5.0) * np.sin(3.0 * a)
    pitch = np.radians(-11.0 + 6.0 * np.sin(2.0 * a + 1.0))
    roll = np.radians(1.5) * np.sin(3.0 * a + 0.7)
    if featureless_wall:
        # The camera looks north at a = 3 pi / 2; there it walks up to the bare wall.
        near = float(np.exp(-(((a - 1.5 * np.pi) / 0.35) ** 2)))
        position = (1.0 - near) * position + near * np.array(_BARE_VIEW)
        heading = (1.0 - near) * heading + near * 2.5 * np.pi
        pitch *= 1.0 - near
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = looking(heading, pitch, roll), position
    return T_wc
