# SPDX-License-Identifier: Apache-2.0
"""The built-in office: a closed room of 5.0 x 4.0 x 2.7 m and what stands in it.

World frame: z up, the floor's middle at the origin, x to the east, y to the north.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ggwarp.datasets.built_in import furniture as f
from ggwarp.datasets.built_in.scene import Lamp, Material, RoomLight, Scene, SceneBuilder, Shape
from ggwarp.kernels.scene import procedural as patterns

LENGTH, WIDTH, HEIGHT = 5.0, 4.0, 2.7
"""Inner size of the room along x, y, z, metres."""

STRUCTURE = ("floor", "ceiling", "north wall", "east wall", "south wall", "west wall")
"""Ids 1 to 6."""


ROOM = RoomLight(
    low=(-0.5 * LENGTH, -0.5 * WIDTH, 0.0),
    high=(0.5 * LENGTH, 0.5 * WIDTH, HEIGHT),
    lamps=(
        Lamp((0.0, -0.9, HEIGHT - 0.12), (0.56, 0.0, 0.0), (0.0, 0.12, 0.0), 0.62),
        Lamp((0.0, 0.9, HEIGHT - 0.12), (0.56, 0.0, 0.0), (0.0, 0.12, 0.0), 0.62),
        Lamp((-0.75, 1.88, 1.55), (0.68, 0.0, 0.0), (0.0, 0.0, 0.52), 0.72),
    ),
    ambient=0.62,
    cell=0.125,
)
"""Two ceiling panels and the window."""


@lru_cache(maxsize=2)
def office_scene(featureless_wall: bool) -> Scene:
    """Return the office, with or without its bare wall."""
    return Scene(*build_office(featureless_wall=featureless_wall), (ROOM,))


def build_office(*, featureless_wall: bool = False) -> tuple[list[Shape], dict[int, str]]:
    """Return the office's shapes and the class name of each object id (1 to N).

    Args:
        featureless_wall: paint the north wall one plain colour and clear its east half.
    """
    s = SceneBuilder()
    _room(s, featureless_wall)
    _desk_side(s)
    _sofa_side(s)
    _shelf_side(s)
    _window_side(s, featureless_wall)
    _middle(s)
    return s.shapes, s.names


def _room(s: SceneBuilder, featureless_wall: bool) -> None:
    x, y, z = 0.5 * LENGTH, 0.5 * WIDTH, 0.5 * HEIGHT
    paper = Material((0.80, 0.77, 0.66), (0.66, 0.70, 0.60), patterns.WALLPAPER, 0.24)
    plaster = Material((0.70, 0.72, 0.74), (0.82, 0.83, 0.84), scale=0.5)
    brick = Material((0.52, 0.26, 0.19), (0.76, 0.46, 0.34), patterns.BRICKS, 0.085)
    bare = Material((0.82, 0.81, 0.78), (0.82, 0.81, 0.78))
    with s.object("floor"):
        s.rectangle((0, 0, 0), "z", (LENGTH, WIDTH), Material(f.OAK.a, f.OAK.b, patterns.WOOD, 0.16))
    with s.object("ceiling"):
        s.rectangle(
            (0, 0, HEIGHT), "z", (LENGTH, WIDTH), Material((0.78,) * 3, (0.92, 0.92, 0.90), scale=0.7)
        )
        for beam in (-1.25, 1.25):
            s.box((beam, 0, HEIGHT - 0.05), (0.14, WIDTH, 0.10), f.WALNUT)
    walls = (
        ((0, y, z), "y", LENGTH, bare if featureless_wall else plaster),
        ((x, 0, z), "x", WIDTH, paper),
        ((0, -y, z), "y", LENGTH, plaster),
        ((-x, 0, z), "x", WIDTH, brick),
    )
    for name, (centre, axis, length, material) in zip(STRUCTURE[2:], walls, strict=True):
        with s.object(name):
            s.rectangle(centre, axis, (length, HEIGHT), material)
            if material is not bare:
                along = (length, 0.02, 0.10) if axis == "y" else (0.02, length, 0.10)
                s.box((0.998 * centre[0], 0.998 * centre[1], 0.05), along, f.WHITE)


def _desk_side(s: SceneBuilder) -> None:
    """The east wall: the desk and what is on it, and a wall shelf."""
    f.desk(s, (2.08, -0.10, 0), -90)
    top = 0.74
    f.monitor(s, (2.22, 0.28, top), -98, (0.10, 0.13, 0.20), (0.20, 0.32, 0.44))
    f.monitor(s, (2.22, -0.36, top), -80, (0.86, 0.88, 0.86), (0.62, 0.72, 0.80))
    f.keyboard(s, (1.92, 0.02, top), -90)
    f.mouse(s, (1.92, -0.36, top))
    f.mug(s, (1.90, 0.42, top), (0.85, 0.82, 0.74), (0.16, 0.34, 0.58))
    f.desk_lamp(s, (2.25, 0.60, top), 200)
    f.pencils(s, (2.10, -0.72, top))
    f.book_stack(s, (2.16, -0.70 + 1.14, top), 30, 5)
    f.office_chair(s, (1.42, -0.15, 0), 105 - 180 + 165)
    with s.object("wall shelf"):
        s.box((2.38, -0.10, 1.72), (0.24, 1.10, 0.03), f.WALNUT)
        for y in (-0.55, 0.35):
            s.box((2.47, y, 1.64), (0.03, 0.03, 0.14), f.DARK)
    f.books(s, (2.38, 0.32, 1.735), -90, 7, 21)
    with s.object("clock", (2.485, 0.95, 2.05)):
        s.frustum((0, 0, 0), 0.16, 0.03, f.WHITE, turn=(0, -90, 0))
        s.frustum((-0.005, 0, 0), 0.18, 0.02, f.DARK, turn=(0, -90, 0))
        s.rod((-0.034, 0, 0), (-0.034, 0.06, 0.07), 0.007, f.DARK)
        s.rod((-0.034, 0, 0), (-0.034, -0.11, 0.03), 0.005, f.DARK)
    with s.object("cactus", (2.36, -0.50, 1.735)):
        s.frustum((0, 0, 0), 0.05, 0.09, Material((0.66, 0.34, 0.22), (0.78, 0.48, 0.34)), taper=1.3)
        s.ball((0, 0, 0.16), (0.05, 0.05, 0.10), f.LEAF)


def _sofa_side(s: SceneBuilder) -> None:
    """The west wall: sofa, cushions, side table with a vase, a big print."""
    f.sofa(s, (-2.05, 0.35, 0), 90)
    f.cushion(
        s,
        (-2.13, 0.86, 0.45),
        70,
        Material((0.80, 0.62, 0.18), (0.90, 0.80, 0.52), patterns.STRIPES, 0.07),
    )
    f.cushion(
        s,
        (-2.13, -0.08, 0.45),
        105,
        Material((0.66, 0.24, 0.26), (0.88, 0.80, 0.74), patterns.CHECKER, 0.06),
    )
    f.picture(
        s,
        "poster",
        (-2.49, 0.40, 1.62),
        90,
        (1.20, 0.80),
        Material((0.90, 0.86, 0.76), (0.36, 0.50, 0.62), patterns.POSTER, 0.16),
    )
    with s.object("side table", (-2.12, -0.92, 0)):
        s.box((0, 0, 0.50), (0.42, 0.42, 0.025), f.BIRCH)
        for x in (-0.18, 0.18):
            for y in (-0.18, 0.18):
                s.rod((1.15 * x, 1.15 * y, 0), (x, y, 0.49), 0.014, f.BIRCH)
    vase = Material((0.16, 0.34, 0.48), (0.74, 0.82, 0.84), patterns.MARBLE, 0.08)
    with s.object("vase", (-2.16, -0.86, 0.5125)):
        s.ball((0, 0, 0.10), (0.09, 0.09, 0.10), vase)
        s.frustum((0, 0, 0.17), 0.035, 0.10, vase, taper=1.4)
        for k in range(5):
            a = 1.3 * k
            tip = (0.13 * np.cos(a), 0.13 * np.sin(a), 0.48 + 0.03 * (k % 3))
            s.rod((0, 0, 0.20), tip, 0.005, f.LEAF)
            petals = ((0.86, 0.44, 0.52), (0.92, 0.76, 0.30), (0.72, 0.44, 0.74))[k % 3]
            s.ball(tip, 0.035, f.cloth(petals, tuple(min(1.0, 1.2 * c) for c in petals), 0.03))
    f.potted_plant(s, (-2.08, 1.60, 0))


def _shelf_side(s: SceneBuilder) -> None:
    """The south wall: bookshelf, cabinet with printer and globe, whiteboard, door, bin."""
    f.bookshelf(s, (-1.28, -1.83, 0), 180)
    for k, (x, z, count) in enumerate(
        ((-0.80, 1.545, 8), (-0.80, 1.175, 11), (-1.05, 0.805, 10), (-0.80, 0.435, 9))
    ):
        f.books(s, (x, -1.83, z), 180, count, 40 + k)
    with s.object("storage box", (-1.30, -1.82, 0.062)):
        s.box((0.20, 0, 0.14), (0.44, 0.26, 0.28), Material((0.30, 0.44, 0.42), (0.46, 0.60, 0.56)))
        s.box((0.20, 0.135, 0.18), (0.12, 0.01, 0.06), f.WHITE)
    f.cabinet(s, (-0.10, -1.76, 0), 180)
    with s.object("printer", (-0.34, -1.76, 0.78), 180):
        s.box((0, 0, 0.11), (0.42, 0.36, 0.20), f.WHITE)
        s.box((0, -0.10, 0.215), (0.36, 0.12, 0.02), f.DARK)
        s.box((0, -0.24, 0.05), (0.26, 0.16, 0.012), f.DARK)
    with s.object("globe", (0.24, -1.74, 0.78)):
        s.frustum((0, 0, 0), 0.08, 0.02, f.WALNUT)
        s.rod((0, 0, 0.02), (0, 0, 0.07), 0.01, f.BRASS)
        s.ball(
            (0, 0, 0.20),
            0.14,
            Material((0.16, 0.36, 0.62), (0.48, 0.60, 0.30), patterns.GLOBE, 0.12),
            turn=(23, 0, 0),
        )
        s.rod((0, -0.062, 0.054), (0, 0.062, 0.346), 0.006, f.BRASS)
    with s.object("whiteboard", (-0.06, -1.99, 1.55), 180):
        s.box((0, -0.008, 0), (1.10, 0.016, 0.72), f.STEEL)
        s.box(
            (0, -0.018, 0),
            (1.04, 0.01, 0.66),
            Material((0.80, 0.81, 0.81), (0.74, 0.77, 0.79), patterns.SCREEN, 0.06),
        )
        s.box((0, -0.05, -0.36), (0.50, 0.07, 0.015), f.STEEL)
    with s.object("door", (1.45, -1.985, 0), 180):
        leaf = Material((0.42, 0.28, 0.18), (0.62, 0.45, 0.30), patterns.WOOD, 0.18, turned=True)
        s.box((0, -0.015, 1.02), (0.90, 0.04, 2.04), leaf)
        for x in (-0.49, 0.49):
            s.box((x, -0.02, 1.05), (0.08, 0.06, 2.10), f.WHITE)
        s.box((0, -0.02, 2.12), (1.06, 0.06, 0.08), f.WHITE)
        s.rod((0.36, -0.04, 1.02), (0.36, -0.10, 1.02), 0.012, f.BRASS)
        s.rod((0.36, -0.09, 1.02), (0.24, -0.09, 1.02), 0.011, f.BRASS)
    with s.object("waste bin", (0.72, -1.72, 0)):
        s.frustum(
            (0, 0, 0),
            0.12,
            0.32,
            Material((0.34, 0.36, 0.40), (0.56, 0.58, 0.62), patterns.STRIPES, 0.06),
            taper=1.25,
        )
    with s.object("traffic cone", (2.22, -1.62, 0)):
        s.box((0, 0, 0.015), (0.34, 0.34, 0.03), f.DARK)
        s.frustum(
            (0, 0, 0.03),
            0.13,
            0.52,
            Material((0.90, 0.36, 0.10), (0.94, 0.92, 0.90), patterns.STRIPES, 0.26),
            taper=0.15,
        )


def _window_side(s: SceneBuilder, featureless_wall: bool) -> None:
    """The north wall: window over a radiator, floor lamp, boxes, stool."""
    f.window(s, (-0.75, 1.99, 1.55))
    f.radiator(s, (-0.75, 1.93, 0.14))
    if featureless_wall:
        return
    f.floor_lamp(s, (2.18, 1.66, 0))
    carton = Material((0.60, 0.46, 0.30), (0.74, 0.59, 0.40), scale=0.15)
    tape = Material((0.78, 0.70, 0.52), (0.84, 0.76, 0.58), scale=0.1)
    for at, yaw, size in (
        ((1.42, 1.66, 0), 12, (0.50, 0.40, 0.36)),
        ((1.46, 1.68, 0.36), -16, (0.36, 0.30, 0.26)),
    ):
        with s.object("cardboard box", at, yaw):
            s.box((0, 0, 0.5 * size[2]), size, carton)
            s.box((0, 0, 0.5 * size[2]), (0.06, size[1] + 0.004, size[2] + 0.004), tape)
    with s.object("stool", (0.66, 1.52, 0)):
        s.frustum((0, 0, 0.44), 0.17, 0.04, f.cloth((0.68, 0.34, 0.16), (0.84, 0.52, 0.26)))
        for k in range(3):
            c, d = np.cos(2.0944 * k + 0.4), np.sin(2.0944 * k + 0.4)
            s.rod((0.20 * c, 0.20 * d, 0), (0.11 * c, 0.11 * d, 0.44), 0.014, f.BIRCH)
    f.picture(
        s,
        "picture",
        (1.40, 1.99, 1.52),
        0,
        (0.62, 0.84),
        Material((0.88, 0.72, 0.52), (0.30, 0.34, 0.50), patterns.POSTER, 0.14),
    )


def _middle(s: SceneBuilder) -> None:
    """The middle of the room: rug, coffee table and what lies there; ceiling lights."""
    with s.object("rug", (-0.62, 0.20, 0)):
        s.box(
            (0, 0, 0.006),
            (1.70, 2.10, 0.012),
            Material((0.60, 0.22, 0.20), (0.84, 0.74, 0.58), patterns.RUG, 0.34),
        )
    f.coffee_table(s, (-0.78, 0.30, 0.012))
    f.fruit_bowl(s, (-0.86, 0.38, 0.442))
    with s.object("magazine", (-0.64, 0.12, 0.442), 25):
        s.box(
            (0, 0, 0.006),
            (0.22, 0.29, 0.012),
            Material((0.90, 0.88, 0.84), (0.80, 0.34, 0.28), patterns.POSTER, 0.08),
        )
    with s.object("ball", (0.55, 0.72, 0)):
        s.ball(
            (0, 0, 0.12),
            0.12,
            Material((0.90, 0.88, 0.82), (0.24, 0.44, 0.66), patterns.CHECKER, 0.09),
            turn=(30, 20, 0),
        )
    for y in (-0.9, 0.9):
        with s.object("ceiling light", (0, y, HEIGHT)):
            s.box((0, 0, -0.03), (1.20, 0.30, 0.06), f.STEEL)
            s.box((0, 0, -0.055), (1.12, 0.24, 0.02), Material((0.96,) * 3, (0.99, 0.99, 0.96), glow=1.0))
