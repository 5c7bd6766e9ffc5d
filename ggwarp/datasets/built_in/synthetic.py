# SPDX-License-Identifier: Apache-2.0
"""The built-in scenes as data sets: rendered on the fly, with exact truth."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np
import warp as wp

from ggwarp.datasets.base import DatasetError
from ggwarp.datasets.built_in.faults import MaskFaults, SensorFaults, faulty_colour, faulty_depth, faulty_mask
from ggwarp.datasets.built_in.office import HEIGHT, LENGTH, WIDTH, build_office
from ggwarp.datasets.built_in.scene import Shape, device_primitives, looking
from ggwarp.datasets.built_in.wall import build_wall, wall_trajectory
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.scene import raycast, shading
from ggwarp.types import Float64, Frame

REPLICA_CAMERA = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5)
FRAME_RATE = 30.0
_LIGHT_CELL = 0.125
_BYTE: Any = wp.uint8
_lock = threading.Lock()

SceneKind = Literal["office", "office with a bare wall", "wall"]
_SCENES: dict[SceneKind, Callable[[], tuple[list[Shape], dict[int, str]]]] = {
    "office": build_office,
    "office with a bare wall": partial(build_office, featureless_wall=True),
    "wall": build_wall,
}
_BARE_VIEW = (1.35, 1.20, 1.40)


class SyntheticScene:
    """A scene of analytic primitives, rendered on the fly along a trajectory.

    Frames carry exact z-depth at pixel centres, the ids of :attr:`class_names` at every pixel (structure
    included; faults are the mask's alone, not the true mask's) and the true pose. A frame depends on its
    index and the options alone. Indexing is safe from several threads at once.
    """

    kind = "synthetic"
    has_depth = True
    has_masks = True

    def __init__(
        self,
        name: str,
        scene: SceneKind,
        trajectory: Float64,
        *,
        scale: float = 1.0,
        faults: SensorFaults = SensorFaults(),  # noqa: B008 - frozen
        mask_faults: MaskFaults = MaskFaults(),  # noqa: B008 - frozen
        without: tuple[int, ...] = (),
        device: Any = "cpu",
    ) -> None:
        """Lay the scene out; its light is baked with the first frame (half a second).

        Args:
            trajectory: [frames, 4, 4] camera-to-world poses.
            scale: of Replica's 1200 x 680 camera; frames are rendered at that size.
            faults: of the camera.
            mask_faults: of the object masks.
            without: ids of objects left out; what remains keeps its look, their shadows
                included, as in a map from which they were removed.
            device: the Warp device that renders.

        Raises:
            DatasetError: no frames, a scale out of (0, 4], or an unknown id.
        """
        if not len(trajectory):
            raise DatasetError(f"{name}: 0 frames; at least 1 is needed")
        if not 0.0 < scale <= 4.0:
            raise DatasetError(f"{name}: scale {scale}; it must lie in (0, 4]")
        shapes, self.class_names = _SCENES[scene]()
        unknown = sorted(set(without) - set(self.class_names))
        if unknown:
            raise DatasetError(f"{name}: without {unknown}; objects are 1 to {len(self.class_names)}")
        self.name = name
        self.camera = REPLICA_CAMERA.scaled(scale)
        self.faults = faults
        self.mask_faults = mask_faults
        self.trajectory = trajectory
        self.ids = np.array(sorted(set(self.class_names) - set(without)), np.int32)
        self._shapes = shapes
        self._uploaded: tuple[wp.array, wp.array, Any] | None = None
        self._without = without
        self._kind: SceneKind = scene
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
        rgb, depth, mask = self.render(T_wc)
        return Frame(
            index=index,
            timestamp=index / FRAME_RATE,
            rgb=faulty_colour(rgb, self.faults, index, index / max(1, len(self) - 1)),
            depth=faulty_depth(depth, self.faults, index, self.camera),
            mask=faulty_mask(mask, self.mask_faults, index, self.ids),
            T_wc=T_wc.copy(),
            true_mask=mask,
        )

    def render(self, T_wc: Float64) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what a faultless camera sees from ``T_wc`` [4, 4].

        Returns:
            rgb [h, w, 3] uint8, depth [h, w] float32 metres, ids [h, w] int32; 0 where nothing is.
        """
        primitives, balls, light = self._scene()
        device = wp.get_device(self._device)
        w, h = self.camera.width, self.camera.height
        tiles = -(-w // raycast.TILE) * -(-h // raycast.TILE)
        count = primitives.shape[0]
        depth = wp.empty((h, w), dtype=float, device=device)
        objects = wp.empty((h, w), dtype=int, device=device)
        colour = wp.empty((h, w, 3), dtype=_BYTE, device=device)
        raycast.render(
            primitives,
            balls,
            light,
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

    def _scene(self) -> tuple[wp.array, wp.array, Any]:
        """Primitives, balls around them and light on the device, made once."""
        with _lock:
            if self._uploaded is None:
                device = wp.get_device(self._device)
                light = _baked_light(self._kind, str(device))
                scene = device_primitives(self._shapes, device=device, without=self._without)
                self._uploaded = (*scene, light)
        return self._uploaded


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
        scene = "office with a bare wall" if featureless_wall else "office"
        super().__init__("office", scene, trajectory, **options)


class SyntheticWall(SyntheticScene):
    """One textured plane and nothing else, along which depth images slide freely."""

    def __init__(self, *, frames: int = 60, **options: Any) -> None:
        """Lay the wall out.

        Args:
            frames: frames of the camera's swaying.
            options: see :class:`SyntheticScene`.
        """
        super().__init__("wall", "wall", wall_trajectory(frames), **options)


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


@lru_cache(maxsize=4)
def _baked_light(scene: SceneKind, device: str) -> Any:
    """The lights of the full room: two ceiling panels and the window."""
    shapes = _SCENES[scene]()[0]
    primitives, balls = device_primitives(shapes, device=device)
    cell = _LIGHT_CELL
    light = shading.Light()
    light.centre = wp.mat33(0.0, -0.9, HEIGHT - 0.12, 0.0, 0.9, HEIGHT - 0.12, -0.75, 1.88, 1.55)
    light.half_u = wp.mat33(0.56, 0.0, 0.0, 0.56, 0.0, 0.0, 0.68, 0.0, 0.0)
    light.half_v = wp.mat33(0.0, 0.12, 0.0, 0.0, 0.12, 0.0, 0.0, 0.0, 0.52)
    light.power = wp.vec3(0.62, 0.62, 0.72)
    light.ambient = 0.62
    light.origin = wp.vec3(0.5 * (cell - LENGTH), 0.5 * (cell - WIDTH), 0.5 * cell)
    light.cell = cell
    size = tuple(int(np.ceil(length / cell)) for length in (LENGTH, WIDTH, HEIGHT))
    light.grid = wp.zeros(size, dtype=wp.vec4, device=device)
    raycast.bake_light(primitives, balls, light, device=device)
    return light
