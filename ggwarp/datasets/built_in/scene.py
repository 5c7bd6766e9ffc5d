# SPDX-License-Identifier: Apache-2.0
"""Building a scene of analytic primitives: objects made of boxes, balls, frustums and rectangles.

World frame: z up, metres. An object is a set of primitives that share one id.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.geometry.se3 import so3_exp
from ggwarp.kernels.scene import primitives as prims
from ggwarp.kernels.scene import procedural

Colour = Sequence[float]
"""Red, green, blue, 0..1 as displayed."""


_PRIMITIVE: Any = prims.Primitive


@dataclass(frozen=True)
class Material:
    """How a surface looks.

    Attributes:
        a, b: its two colours, 0..1 as displayed.
        pattern: one of the patterns of :mod:`ggwarp.kernels.scene.procedural`.
        scale: the pattern's main length, metres.
        turned: texture coordinates swapped (boards upright rather than lying).
        glow: share of the light that is its own.
    """

    a: Colour
    b: Colour
    pattern: int = procedural.MOTTLED
    scale: float = 0.2
    turned: bool = False
    glow: float = 0.0


@dataclass(frozen=True)
class Shape:
    """One placed primitive: ``kind``, [3] centre, [3, 3] rotation, [3] half sizes, world frame."""

    kind: int
    object_id: int
    centre: NDArray[np.float64]
    rotation: NDArray[np.float64]
    size: NDArray[np.float64]
    taper: float
    material: Material

    @property
    def radius(self) -> float:
        """Radius of a ball around the centre that holds the shape, metres."""
        if self.kind == prims.SPHERE:
            return float(self.size.max())
        if self.kind == prims.BOX:
            return float(np.linalg.norm(self.size))
        if self.kind == prims.RECTANGLE:
            return float(np.linalg.norm(self.size[:2]))
        widest = self.size[:2].max() * max(1.0, self.taper)
        return float(np.hypot(widest, self.size[2]))


@dataclass
class SceneBuilder:
    """Collects shapes under a current object and a current placement.

    Attributes:
        shapes: what was built.
        names: class name of each object id; ids count from 1.
    """

    shapes: list[Shape] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    _origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    _turn: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))

    @contextmanager
    def object(self, name: str, at: ArrayLike = (0, 0, 0), yaw: float = 0.0) -> Iterator[None]:
        """Start a new object at ``at``, turned by ``yaw`` degrees about the vertical."""
        self.names[len(self.names) + 1] = name
        before = self._origin, self._turn
        self._origin = self._origin + self._turn @ np.asarray(at, np.float64)
        self._turn = self._turn @ so3_exp([0.0, 0.0, np.radians(yaw)])
        yield
        self._origin, self._turn = before

    def box(
        self, centre: ArrayLike, size: ArrayLike, material: Material, *, turn: ArrayLike = (0, 0, 0)
    ) -> None:
        """Add a box of full ``size``; ``turn``: its rotation vector, degrees."""
        self._add(prims.BOX, centre, turn, 0.5 * np.asarray(size, np.float64), 0.0, material)

    def ball(
        self, centre: ArrayLike, radii: ArrayLike, material: Material, *, turn: ArrayLike = (0, 0, 0)
    ) -> None:
        """Add an ellipsoid (a sphere when ``radii`` is one number)."""
        self._add(
            prims.SPHERE, centre, turn, np.broadcast_to(np.asarray(radii, np.float64), 3), 0.0, material
        )

    def frustum(
        self,
        base: ArrayLike,
        radius: float,
        height: float,
        material: Material,
        *,
        taper: float = 1.0,
        turn: ArrayLike = (0, 0, 0),
    ) -> None:
        """Add an upright frustum on ``base``: a cylinder, with ``taper`` 0 a cone."""
        axis = so3_exp(np.radians(np.asarray(turn, np.float64)))[:, 2]
        centre = np.asarray(base, np.float64) + 0.5 * height * axis
        self._add(prims.FRUSTUM, centre, turn, np.array([radius, radius, 0.5 * height]), taper, material)

    def rod(
        self, start: ArrayLike, end: ArrayLike, radius: float, material: Material, *, taper: float = 1.0
    ) -> None:
        """Add a thin frustum from ``start`` to ``end``."""
        a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
        length = float(np.linalg.norm(b - a))
        z = (b - a) / length
        w = np.cross([0.0, 0.0, 1.0], z)
        sine = float(np.linalg.norm(w))
        angle = np.arctan2(sine, z[2])
        turn = np.degrees(angle) * (w / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0]))
        self.frustum(a, radius, length, material, taper=taper, turn=turn)

    def rectangle(self, centre: ArrayLike, axis: str, size: tuple[float, float], material: Material) -> None:
        """Add a rectangle across ``axis`` ("x", "y" or "z"); ``size``: its other two lengths, z last."""
        columns = {
            "x": ([0, 1, 0], [0, 0, 1], [1, 0, 0]),
            "y": ([1, 0, 0], [0, 0, 1], [0, -1, 0]),
            "z": ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
        }[axis]
        half = np.array([0.5 * size[0], 0.5 * size[1], 1.0])
        self._place(prims.RECTANGLE, centre, np.array(columns, np.float64).T, half, 0.0, material)

    def _add(
        self,
        kind: int,
        centre: ArrayLike,
        turn: ArrayLike,
        size: NDArray[np.float64],
        taper: float,
        material: Material,
    ) -> None:
        self._place(kind, centre, so3_exp(np.radians(np.asarray(turn, np.float64))), size, taper, material)

    def _place(
        self,
        kind: int,
        centre: ArrayLike,
        rotation: NDArray[np.float64],
        size: NDArray[np.float64],
        taper: float,
        material: Material,
    ) -> None:
        world = self._origin + self._turn @ np.asarray(centre, np.float64)
        self.shapes.append(Shape(kind, len(self.names), world, self._turn @ rotation, size, taper, material))


Point = tuple[float, float, float]


@dataclass(frozen=True)
class Lamp:
    """A rectangular light: [3] centre and halves of its two sides, metres, and its power, display units."""

    centre: Point
    half_u: Point
    half_v: Point
    power: float


@dataclass(frozen=True)
class RoomLight:
    """A room and its light.

    Attributes:
        low, high: the room's corners, metres.
        lamps: three at most.
        ambient: light without direction.
        cell: of the grid on which what is seen of the lamps is baked, metres.
    """

    low: Point
    high: Point
    lamps: tuple[Lamp, ...]
    ambient: float
    cell: float


@dataclass(frozen=True, eq=False)
class Scene:
    """A built scene: its shapes, the class name of each object id (1 to N), and its rooms' light."""

    shapes: list[Shape]
    names: dict[int, str]
    rooms: tuple[RoomLight, ...]


def primitive_rows(shapes: list[Shape], *, first: int = 0) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Return ``shapes`` as the ray-caster takes them: [n] Primitive, [n, 4] balls around them.

    A texture's seed is its shape's place in ``shapes``, counted from ``first``: leaving some of the rows
    out changes no other.
    """
    rows = np.zeros(len(shapes), np.dtype(_PRIMITIVE.numpy_dtype()))
    balls = np.zeros((len(shapes), 4), np.float32)
    for k, (row, shape) in enumerate(zip(rows, shapes, strict=True)):
        material = shape.material
        row["kind"], row["object_id"], row["taper"] = shape.kind, shape.object_id, shape.taper
        row["centre"], row["size"] = shape.centre, shape.size
        row["to_unit"] = shape.rotation.T / shape.size[:, None]
        row["pattern"], row["turned"], row["scale"] = material.pattern, material.turned, material.scale
        row["colour_a"], row["colour_b"] = material.a, material.b
        row["seed"], row["glow"] = 101 * (first + k) + 7, material.glow
        balls[k] = [*shape.centre, 1.0001 * shape.radius]
    return rows, balls


def device_arrays(
    rows: NDArray[Any], balls: NDArray[np.float32], *, device: Any
) -> tuple[wp.array, wp.array]:
    """Upload what :func:`primitive_rows` returns: [n] Primitive, [n] vec4."""
    return (
        wp.array(rows, dtype=_PRIMITIVE, device=device),
        wp.array(balls, dtype=wp.vec4, device=device),
    )


def in_view(balls: NDArray[np.float32], camera: Camera, T_wc: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of ``balls`` [n, 4] reach into the pyramid that ``camera`` sees from ``T_wc``, [n]."""
    at = (balls[:, :3] - T_wc[:3, 3]) @ T_wc[:3, :3]
    inside = at[:, 2] > -balls[:, 3]
    for axis, focal, centre, size in (
        (0, camera.fx, camera.cx, camera.width),
        (1, camera.fy, camera.cy, camera.height),
    ):
        # The sides of the pyramid, a pixel out, and the distance of the balls' centres beyond them.
        for tangent, sign in (((centre + 1.5) / focal, -1.0), ((size + 0.5 - centre) / focal, 1.0)):
            beyond = (sign * at[:, axis] - tangent * at[:, 2]) / np.hypot(1.0, tangent)
            inside &= beyond <= balls[:, 3]
    return inside


def looking(heading: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Return [3, 3] the axes (columns: right, down, forward) of a camera that looks along ``heading``.

    Args:
        heading: about the vertical, from east over north, radians.
        pitch: upwards. roll: to the left about the line of sight.
    """
    forward = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)])
    level = np.array([np.sin(heading), -np.cos(heading), 0.0])
    down = np.cross(forward, level)
    right = np.cos(roll) * level + np.sin(roll) * down
    return np.column_stack([right, np.cross(forward, right), forward])
