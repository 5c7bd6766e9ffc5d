# SPDX-License-Identifier: Apache-2.0
"""The built-in apartment: living room, kitchen, bedroom and study around a corridor.

World frame: z up, metres, x to the east from the west wall, y to the north from the south wall. The rooms
join in a ring: living room, kitchen, corridor, bedroom, study, corridor, living room.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

from ggwarp.datasets.built_in import apartment_rooms as rooms
from ggwarp.datasets.built_in import furniture as f
from ggwarp.datasets.built_in.scene import Lamp, Material, RoomLight, Scene, SceneBuilder
from ggwarp.kernels.scene import procedural as patterns

HEIGHT = rooms.HEIGHT
LENGTH, WIDTH = 8.6, 9.4
"""Inner size of the whole along x and y."""

_WALL = 0.2
_LINTEL = 2.06
_CELL = 0.2
"""Of the grid of light: walls are as thick as a cell, and the rooms whole cells long."""

_PLASTER = Material((0.70, 0.69, 0.64), (0.84, 0.83, 0.78), scale=0.45)
_BRICK = Material((0.52, 0.28, 0.20), (0.76, 0.50, 0.38), patterns.BRICKS, 0.085)
_TILES = Material((0.86, 0.88, 0.86), (0.62, 0.74, 0.76), patterns.CHECKER, 0.20)
_PAPER = Material((0.74, 0.76, 0.80), (0.60, 0.64, 0.74), patterns.WALLPAPER, 0.22)
_GREEN = Material((0.56, 0.64, 0.54), (0.70, 0.76, 0.66), scale=0.40)
_OCHRE = Material((0.78, 0.68, 0.48), (0.88, 0.80, 0.64), scale=0.50)
_CEILING = Material((0.80, 0.80, 0.78), (0.92, 0.92, 0.90), scale=0.7)


@dataclass(frozen=True)
class _Room:
    """A room: its corners on the floor, what it is covered with, and the openings of its walls.

    ``openings`` are stretches along a wall, metres: in x on the north and south wall, in y on the others.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    floor: Material
    walls: tuple[Material, Material, Material, Material]  # west, east, south, north
    openings: dict[int, list[tuple[float, float]]] = field(default_factory=dict)


_WEST, _EAST, _SOUTH, _NORTH = range(4)

ROOMS = {
    "living room": _Room(
        (0.0, 0.0),
        (4.8, 4.0),
        Material(f.OAK.a, f.OAK.b, patterns.WOOD, 0.16),
        (_BRICK, _PLASTER, _PLASTER, _PLASTER),
        {_EAST: [(1.5, 2.7)], _NORTH: [(2.2, 3.1)]},
    ),
    "kitchen": _Room(
        (5.0, 0.0),
        (8.6, 4.0),
        Material((0.78, 0.74, 0.66), (0.42, 0.40, 0.38), patterns.CHECKER, 0.30),
        (_OCHRE, _OCHRE, _TILES, _OCHRE),
        {_WEST: [(1.5, 2.7)], _NORTH: [(7.5, 8.4)]},
    ),
    "corridor": _Room(
        (0.0, 4.2),
        (8.6, 5.6),
        Material(f.WALNUT.a, f.WALNUT.b, patterns.WOOD, 0.12),
        (_GREEN, _GREEN, _GREEN, _GREEN),
        {_SOUTH: [(2.2, 3.1), (7.5, 8.4)], _NORTH: [(0.5, 1.4), (5.0, 5.9)]},
    ),
    "bedroom": _Room(
        (4.2, 5.8),
        (8.6, 9.4),
        Material((0.44, 0.40, 0.36), (0.64, 0.60, 0.54), patterns.CARPET, 0.2),
        (_PLASTER, _PAPER, _PAPER, _PAPER),
        {_WEST: [(7.6, 8.5)], _SOUTH: [(5.0, 5.9)]},
    ),
    "study": _Room(
        (0.0, 5.8),
        (4.0, 9.4),
        Material(f.BIRCH.a, f.BIRCH.b, patterns.WOOD, 0.14),
        (_OCHRE, _PLASTER, _PLASTER, _GREEN),
        {_EAST: [(7.6, 8.5)], _SOUTH: [(0.5, 1.4)]},
    ),
}

_WINDOWS = {"living room": (0.0, 2.0), "kitchen": (8.6, 2.3), "bedroom": (7.1, 9.4), "study": (1.0, 9.4)}
"""Middle of each room's window, on its wall."""

_DOORWAYS = (
    ("y", 4.1, 2.2, 3.1),
    ("y", 4.1, 7.5, 8.4),
    ("y", 5.7, 0.5, 1.4),
    ("y", 5.7, 5.0, 5.9),
    ("x", 4.9, 1.5, 2.7),
    ("x", 4.1, 7.6, 8.5),
)
"""Axis across the wall, the wall's middle, and the opening along it."""


@lru_cache(maxsize=1)
def apartment_scene() -> Scene:
    """Return the apartment: its shapes, names and light."""
    s = SceneBuilder()
    for name, room in ROOMS.items():
        _shell(s, name, room)
    for doorway in _DOORWAYS:
        _door_frame(s, *doorway)
    rooms.furnish_living_room(s)
    rooms.furnish_kitchen(s)
    rooms.furnish_corridor(s)
    rooms.furnish_bedroom(s)
    rooms.furnish_study(s)
    return Scene(s.shapes, s.names, tuple(_light(name, room) for name, room in ROOMS.items()))


def _shell(s: SceneBuilder, name: str, room: _Room) -> None:
    """A room's floor, ceiling and walls: three objects."""
    (x0, y0), (x1, y1) = room.low, room.high
    middle = (0.5 * (x0 + x1), 0.5 * (y0 + y1))
    with s.object(f"{name} floor"):
        s.rectangle((*middle, 0.0), "z", (x1 - x0, y1 - y0), room.floor)
    with s.object(f"{name} ceiling"):
        s.rectangle((*middle, HEIGHT), "z", (x1 - x0, y1 - y0), _CEILING)
    with s.object(f"{name} walls"):
        for side, paint in enumerate(room.walls):
            across = "x" if side in (_WEST, _EAST) else "y"
            plane = (x0, x1, y0, y1)[side]
            inward = 0.01 if side in (_WEST, _SOUTH) else -0.01
            start, end = (y0, y1) if across == "x" else (x0, x1)
            edges = [start, *(edge for gap in room.openings.get(side, []) for edge in gap), end]
            for a, b in zip(edges[::2], edges[1::2], strict=True):
                m = 0.5 * (a + b)
                at = (plane, m) if across == "x" else (m, plane)
                s.rectangle((*at, 0.5 * HEIGHT), across, (b - a, HEIGHT), paint)
                foot = (plane + inward, m) if across == "x" else (m, plane + inward)
                s.box((*foot, 0.04), (0.02, b - a, 0.08) if across == "x" else (b - a, 0.02, 0.08), f.WHITE)


def _door_frame(s: SceneBuilder, axis: str, plane: float, start: float, end: float) -> None:
    """Lining, threshold and the panel above an opening, up to the ceiling."""
    deep = _WALL + 0.03

    def place(along: float, z: float, length: float, high: float, depth: float) -> None:
        centre = (plane, along, z) if axis == "x" else (along, plane, z)
        s.box(centre, (depth, length, high) if axis == "x" else (length, depth, high), f.WHITE)

    m = 0.5 * (start + end)
    with s.object("door frame"):
        for edge in (start, end):
            place(edge, 0.5 * _LINTEL, 0.06, _LINTEL, deep)
        place(m, 0.5 * (_LINTEL + HEIGHT), end - start + 0.06, HEIGHT - _LINTEL, deep)
        sill = (end - start, deep) if axis == "y" else (deep, end - start)
        s.box((plane, m, 0.006) if axis == "x" else (m, plane, 0.006), (*sill, 0.012), f.WALNUT)


def _light(name: str, room: _Room) -> RoomLight:
    """A lamp in the middle of the ceiling, or two along the corridor, and the window."""
    (x0, y0), (x1, y1) = room.low, room.high
    x, y, z = 0.5 * (x0 + x1), 0.5 * (y0 + y1), HEIGHT - 0.18
    side = (0.3, 0.0, 0.0), (0.0, 0.3, 0.0)
    if name in _WINDOWS:
        at = _WINDOWS[name]
        on_x_wall = at[0] in (x0, x1)
        inside = (at[0] + (0.15 if at[0] == x0 else -0.15), at[1]) if on_x_wall else (at[0], at[1] - 0.15)
        half = (0.0, 0.65, 0.0) if on_x_wall else (0.65, 0.0, 0.0)
        lamps = (Lamp((x, y, z), *side, 0.85), Lamp((*inside, 1.5), half, (0.0, 0.0, 0.5), 0.9))
    else:
        lamps = tuple(Lamp((x0 + share * (x1 - x0), y, z), *side, 0.62) for share in (0.25, 0.75))
    return RoomLight((x0, y0, 0.0), (x1, y1, HEIGHT), lamps, ambient=0.62, cell=_CELL)
