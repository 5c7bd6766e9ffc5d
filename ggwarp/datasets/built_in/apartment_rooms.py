# SPDX-License-Identifier: Apache-2.0
"""What stands in each room of the built-in apartment, in the frame of its plan."""

from __future__ import annotations

from numpy.typing import ArrayLike

from ggwarp.datasets.built_in import furniture as f
from ggwarp.datasets.built_in import home_furniture as h
from ggwarp.datasets.built_in.scene import Colour, Material, SceneBuilder
from ggwarp.kernels.scene import procedural as patterns

HEIGHT = 2.6
"""Of the ceilings, metres."""


def _picture(
    s: SceneBuilder,
    at: ArrayLike,
    yaw: float,
    size: tuple[float, float],
    a: Colour,
    b: Colour,
    scale: float = 0.14,
) -> None:
    """A framed print hanging at ``at`` (its middle)."""
    f.picture(s, "picture", at, yaw, size, Material(a, b, patterns.POSTER, scale))


def furnish_living_room(s: SceneBuilder) -> None:
    f.sofa(s, (0.48, 2.0, 0), 90)
    f.cushion(
        s, (0.44, 2.5, 0.45), 70, Material((0.80, 0.62, 0.18), (0.90, 0.80, 0.52), patterns.STRIPES, 0.07)
    )
    f.cushion(
        s, (0.44, 1.5, 0.45), 105, Material((0.66, 0.24, 0.26), (0.88, 0.80, 0.74), patterns.CHECKER, 0.06)
    )
    f.window(s, (0.0, 2.0, 1.60), 90)
    h.curtain(s, (0.10, 0.95, 0), 90, (0.62, 0.42, 0.30))
    h.curtain(s, (0.10, 3.05, 0), 90, (0.62, 0.42, 0.30))
    rug = Material((0.58, 0.22, 0.20), (0.84, 0.74, 0.58), patterns.RUG, 0.34)
    with s.object("rug", (1.45, 2.0, 0)):
        s.box((0, 0, 0.006), (1.70, 2.30, 0.012), rug)
    f.coffee_table(s, (1.40, 2.0, 0.012))
    f.fruit_bowl(s, (1.34, 2.08, 0.442))
    f.book_stack(s, (1.50, 1.80, 0.442), 25, 6)
    h.television(s, (2.30, 0.26, 0), 180)
    _picture(s, (2.30, 0.0, 1.72), 180, (1.10, 0.60), (0.88, 0.80, 0.66), (0.30, 0.44, 0.56))
    f.floor_lamp(s, (0.45, 0.40, 0))
    f.potted_plant(s, (3.55, 0.45, 0))
    h.armchair(s, (4.22, 0.62, 0), -140)
    _picture(s, (4.8, 0.72, 1.55), -90, (0.60, 0.80), (0.90, 0.86, 0.76), (0.62, 0.30, 0.24))
    f.bookshelf(s, (1.20, 3.83, 0), 0)
    for k, (x, z, count) in enumerate(
        ((0.72, 1.545, 8), (0.72, 1.175, 11), (0.95, 0.805, 10), (0.72, 0.435, 9))
    ):
        f.books(s, (x, 3.83, z), 0, count, 60 + k)
    f.cabinet(s, (4.10, 3.76, 0), 0)
    h.vase(s, (3.80, 3.76, 0.78))
    h.table_lamp(s, (4.40, 3.78, 0.78))
    _picture(s, (3.95, 4.0, 1.62), 0, (0.90, 0.60), (0.34, 0.48, 0.52), (0.90, 0.78, 0.52))
    _picture(s, (4.8, 3.35, 1.60), -90, (0.70, 0.50), (0.30, 0.30, 0.44), (0.86, 0.70, 0.60))
    h.ceiling_lamp(s, (2.4, 2.0, HEIGHT), 0.05)
    h.door_leaf(s, (3.13, 3.97, 0), -90)


def furnish_kitchen(s: SceneBuilder) -> None:
    h.kitchen_counter(s, (6.42, 0.31, 0), 180, 2.80)
    h.wall_cupboards(s, (6.42, 0.16, 1.46), 180, 2.80)
    h.fridge(s, (8.20, 0.34, 0), 180)
    h.kettle(s, (6.45, 0.34, 0.90))
    h.bottles(s, (5.42, 0.16, 0.90), 180)
    f.mug(s, (7.10 - 1.35, 0.42, 0.90), (0.85, 0.82, 0.74), (0.16, 0.34, 0.58))
    f.fruit_bowl(s, (7.62, 0.32, 0.90))
    h.dining_table(s, (6.25, 3.05, 0), 0)
    h.vase(s, (6.40, 3.05, 0.753))
    f.mug(s, (5.90, 2.90, 0.753), (0.84, 0.62, 0.30), (0.30, 0.22, 0.20))
    for x, y, yaw in ((5.92, 2.52, 175), (6.60, 2.50, 190), (5.95, 3.58, 5), (6.58, 3.60, -8)):
        h.chair(s, (x, y, 0), yaw)
    f.window(s, (8.6, 2.3, 1.60), -90)
    f.radiator(s, (8.53, 2.3, 0.14), -90)
    h.curtain(s, (8.50, 1.25, 0), -90, (0.84, 0.70, 0.36))
    _picture(s, (6.25, 4.0, 1.60), 0, (1.20, 0.70), (0.92, 0.82, 0.56), (0.40, 0.52, 0.36), 0.18)
    _picture(s, (5.0, 3.35, 1.60), 90, (0.50, 0.70), (0.88, 0.76, 0.68), (0.24, 0.40, 0.44))
    with s.object("shelf", (5.0, 0.95, 0), 90):
        for z in (1.20, 1.55):
            s.box((0, -0.10, z), (0.70, 0.20, 0.025), f.WALNUT)
    h.bottles(s, (5.12, 0.95, 1.2125), 90)
    f.mug(s, (5.12, 0.80, 1.5625), (0.30, 0.50, 0.46), (0.90, 0.88, 0.80))
    with s.object("bin", (5.28, 2.98, 0)):
        s.frustum(
            (0, 0, 0), 0.14, 0.50, Material((0.30, 0.34, 0.40), (0.54, 0.58, 0.64), patterns.STRIPES, 0.08)
        )
    h.ceiling_lamp(s, (6.25, 3.05, HEIGHT), 0.75)
    h.ceiling_lamp(s, (6.8, 1.3, HEIGHT), 0.02)
    h.door_leaf(s, (8.42, 3.97, 0), -90)


def furnish_corridor(s: SceneBuilder) -> None:
    runner = Material((0.24, 0.34, 0.44), (0.82, 0.74, 0.60), patterns.RUG, 0.28)
    with s.object("runner", (4.3, 4.9, 0)):
        s.box((0, 0, 0.005), (5.60, 0.75, 0.010), runner)
    h.coat_rack(s, (3.70, 5.6, 0), 0)
    h.shoe_shelf(s, (2.45, 5.45, 0), 0)
    h.vase(s, (2.25, 5.45, 0.61))
    with s.object("front door", (0.0, 4.9, 0), 90):
        leaf = Material((0.34, 0.20, 0.14), (0.54, 0.36, 0.26), patterns.WOOD, 0.18, turned=True)
        s.box((0, -0.02, 1.02), (0.92, 0.04, 2.04), leaf)
        for x in (-0.50, 0.50):
            s.box((x, -0.02, 1.05), (0.08, 0.06, 2.10), f.WHITE)
        s.box((0, -0.02, 2.12), (1.08, 0.06, 0.08), f.WHITE)
        for z in (0.55, 1.45):
            s.box(
                (0, -0.045, z), (0.60, 0.01, 0.70), Material(leaf.b, leaf.a, patterns.WOOD, 0.14, turned=True)
            )
        s.rod((0.36, -0.08, 1.02), (0.24, -0.08, 1.02), 0.012, f.BRASS)
    prints = (
        ((4.45, 4.2, 1.60), 180, (0.60, 0.45), (0.86, 0.84, 0.78), (0.56, 0.28, 0.22)),
        ((5.55, 4.2, 1.58), 180, (0.45, 0.62), (0.26, 0.36, 0.50), (0.90, 0.80, 0.58)),
        ((6.55, 4.2, 1.62), 180, (0.70, 0.50), (0.88, 0.70, 0.50), (0.30, 0.44, 0.38)),
        ((6.60, 5.6, 1.60), 0, (0.55, 0.75), (0.90, 0.88, 0.82), (0.22, 0.30, 0.44)),
        ((7.55, 5.6, 1.60), 0, (0.60, 0.60), (0.80, 0.54, 0.40), (0.30, 0.26, 0.34)),
        ((2.65, 5.6, 1.55), 0, (0.40, 0.55), (0.84, 0.80, 0.70), (0.30, 0.50, 0.52)),
        ((1.35, 4.2, 1.60), 180, (0.80, 0.55), (0.36, 0.46, 0.40), (0.92, 0.82, 0.62)),
        ((8.6, 4.9, 1.60), -90, (0.70, 0.90), (0.86, 0.76, 0.66), (0.40, 0.24, 0.36)),
    )
    for at, yaw, size, a, b in prints:
        _picture(s, at, yaw, size, a, b)
    f.cabinet(s, (6.95, 5.45 + 0.10, 0), 0)
    f.book_stack(s, (7.20, 5.42, 0.78), 10, 8)
    with s.object("umbrella stand", (0.32, 4.42, 0)):
        s.frustum(
            (0, 0, 0), 0.11, 0.48, Material((0.26, 0.30, 0.28), (0.46, 0.52, 0.48), patterns.STRIPES, 0.10)
        )
        s.rod((0.02, 0, 0.10), (0.06, 0.03, 0.86), 0.022, f.cloth((0.5, 0.16, 0.2), (0.7, 0.26, 0.28)))
    f.radiator(s, (4.05, 4.27, 0.14), 180)
    for x, y, yaw in ((7.02, 4.2, 180), (0.60, 4.2, 180), (1.95, 5.6, 0), (6.05, 5.6, 0)):
        h.wall_lamp(s, (x, y, 1.75), yaw)
    for x in (2.15, 6.45):
        h.ceiling_lamp(s, (x, 4.9, HEIGHT), 0.03)


def furnish_bedroom(s: SceneBuilder) -> None:
    h.bed(s, (7.55, 7.75, 0), -90)
    h.nightstand(s, (8.36, 6.62, 0), -90)
    h.nightstand(s, (8.36, 8.90, 0), -90)
    h.table_lamp(s, (8.40, 6.62, 0.51))
    h.table_lamp(s, (8.40, 8.90, 0.51))
    _picture(s, (8.6, 7.75, 1.65), -90, (1.30, 0.70), (0.90, 0.84, 0.74), (0.34, 0.48, 0.60), 0.18)
    h.wardrobe(s, (7.35, 6.10, 0), 180)
    f.window(s, (7.1, 9.4, 1.60))
    f.radiator(s, (7.1, 9.33, 0.14))
    h.curtain(s, (6.1, 9.30, 0), 0, (0.40, 0.50, 0.62))
    h.curtain(s, (8.1, 9.30, 0), 0, (0.40, 0.50, 0.62))
    h.chest(s, (5.25, 9.16, 0), 0)
    h.vase(s, (5.00, 9.16, 0.86))
    f.book_stack(s, (5.50, 9.14, 0.86), -12, 12)
    _picture(s, (5.25, 9.4, 1.55), 0, (0.60, 0.80), (0.80, 0.84, 0.86), (0.62, 0.68, 0.72), 0.3)
    f.potted_plant(s, (4.55, 6.15, 0))
    _picture(s, (4.2, 6.80, 1.60), 90, (0.60, 0.85), (0.30, 0.34, 0.50), (0.88, 0.72, 0.52))
    h.basket(s, (4.48, 9.12, 0))
    with s.object("bedside rug", (5.95, 7.75, 0)):
        s.box(
            (0, 0, 0.008),
            (0.80, 1.70, 0.016),
            Material((0.76, 0.68, 0.56), (0.44, 0.30, 0.30), patterns.RUG, 0.26),
        )
    h.ceiling_lamp(s, (6.4, 7.6, HEIGHT), 0.04)
    h.door_leaf(s, (5.93, 5.83, 0), 90)


def furnish_study(s: SceneBuilder) -> None:
    f.desk(s, (2.45, 8.98, 0), 0)
    top = 0.74
    f.monitor(s, (2.20, 9.14, top), 8, (0.10, 0.13, 0.20), (0.20, 0.32, 0.44))
    f.monitor(s, (2.82, 9.12, top), -12, (0.86, 0.88, 0.86), (0.62, 0.72, 0.80))
    f.keyboard(s, (2.40, 8.80, top), 0)
    f.mouse(s, (2.78, 8.80, top))
    f.mug(s, (1.90, 8.86, top), (0.85, 0.82, 0.74), (0.56, 0.24, 0.18))
    f.desk_lamp(s, (1.78, 9.14, top), 300)
    f.pencils(s, (3.14, 9.10, top))
    f.office_chair(s, (2.45, 8.38, 0), 165)
    f.bookshelf(s, (0.17, 7.80, 0), 90)
    for k, (y, z, count) in enumerate(
        ((7.32, 1.545, 9), (7.32, 1.175, 10), (7.40, 0.805, 9), (7.32, 0.435, 8))
    ):
        f.books(s, (0.17, y, z), 90, count, 80 + k)
    f.window(s, (1.0, 9.4, 1.60))
    f.radiator(s, (1.0, 9.33, 0.14))
    h.armchair(s, (3.45, 6.40, 0), -35 + 180)
    f.floor_lamp(s, (2.75, 6.10, 0))
    f.cabinet(s, (2.05, 6.05, 0), 180)
    with s.object("globe", (1.80, 6.05, 0.78)):
        s.frustum((0, 0, 0), 0.08, 0.02, f.WALNUT)
        s.rod((0, 0, 0.02), (0, 0, 0.07), 0.01, f.BRASS)
        s.ball((0, 0, 0.20), 0.14, Material((0.16, 0.36, 0.62), (0.48, 0.60, 0.30), patterns.GLOBE, 0.12))
    f.book_stack(s, (2.35, 6.05, 0.78), 70, 17)
    _picture(s, (2.05, 5.8, 1.60), 180, (1.00, 0.80), (0.92, 0.88, 0.78), (0.32, 0.46, 0.60), 0.16)
    _picture(s, (0.0, 6.55, 1.55), 90, (0.60, 0.85), (0.82, 0.46, 0.34), (0.92, 0.86, 0.72), 0.16)
    _picture(s, (4.0, 7.05, 1.60), -90, (0.70, 0.55), (0.34, 0.42, 0.36), (0.92, 0.84, 0.66))
    _picture(s, (4.0, 9.0, 1.60), -90, (0.45, 0.60), (0.28, 0.34, 0.52), (0.90, 0.70, 0.48))
    carton = Material((0.60, 0.46, 0.30), (0.74, 0.59, 0.40), scale=0.15)
    for at, yaw, size in (
        ((0.36, 8.85, 0), 8, (0.44, 0.40, 0.36)),
        ((0.34, 8.86, 0.36), -16, (0.34, 0.30, 0.26)),
    ):
        with s.object("cardboard box", at, yaw):
            s.box((0, 0, 0.5 * size[2]), size, carton)
    rug = Material((0.34, 0.42, 0.36), (0.86, 0.80, 0.64), patterns.RUG, 0.30)
    with s.object("rug", (2.0, 7.30, 0)):
        s.box((0, 0, 0.006), (1.90, 1.40, 0.012), rug)
    h.ceiling_lamp(s, (2.0, 7.6, HEIGHT), 0.04)
    h.door_leaf(s, (0.47, 5.83, 0), 90)
