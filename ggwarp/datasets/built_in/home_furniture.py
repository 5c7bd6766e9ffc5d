# SPDX-License-Identifier: Apache-2.0
"""What the built-in apartment has that an office has not: each function adds one object (an id of its own).

Sizes are those of real things, metres. An object faces -y in its own frame before ``yaw``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ggwarp.datasets.built_in.furniture import BIRCH, BRASS, DARK, LEAF, OAK, STEEL, WALNUT, WHITE, cloth
from ggwarp.datasets.built_in.scene import Colour, Material, SceneBuilder
from ggwarp.kernels.scene import procedural as patterns

_STONE = Material((0.26, 0.27, 0.29), (0.52, 0.50, 0.48), patterns.MARBLE, 0.10)
_FRONT = Material((0.62, 0.68, 0.66), (0.72, 0.77, 0.74), scale=0.2)


def bed(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A double bed 1.6 x 2.05 m, its head at +y, with a blanket and two pillows."""
    blanket = Material((0.22, 0.32, 0.48), (0.78, 0.76, 0.68), patterns.RUG, 0.22)
    sheet = cloth((0.80, 0.80, 0.78), (0.92, 0.92, 0.90), 0.10)
    with s.object("bed", at, yaw):
        s.box((0, 0, 0.22), (1.66, 2.05, 0.20), WALNUT)
        s.box((0, 0, 0.40), (1.58, 1.98, 0.18), sheet)
        s.box((0, -0.28, 0.495), (1.68, 1.46, 0.05), blanket)
        s.box((-0.835, -0.28, 0.36), (0.02, 1.46, 0.30), blanket)
        s.box((0.835, -0.28, 0.36), (0.02, 1.46, 0.30), blanket)
        s.box((0, 1.02, 0.55), (1.70, 0.06, 0.95), OAK)
        for x in (-0.40, 0.40):
            s.ball((x, 0.72, 0.54), (0.33, 0.22, 0.10), sheet, turn=(12, 0, 0))
        for x in (-0.78, 0.78):
            for y in (-0.95, 0.95):
                s.box((x, y, 0.06), (0.07, 0.07, 0.12), WALNUT)


def nightstand(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A nightstand with two drawers."""
    with s.object("nightstand", at, yaw):
        s.box((0, 0, 0.28), (0.42, 0.38, 0.46), OAK)
        for z in (0.18, 0.38):
            s.box((0, -0.195, z), (0.38, 0.015, 0.18), BIRCH)
            s.ball((0, -0.21, z), 0.014, BRASS)


def table_lamp(s: SceneBuilder, at: ArrayLike) -> None:
    """A lamp with a round foot and a cloth shade."""
    with s.object("table lamp", at):
        s.ball((0, 0, 0.09), (0.07, 0.07, 0.09), Material((0.20, 0.38, 0.40), (0.44, 0.64, 0.62), scale=0.06))
        s.rod((0, 0, 0.16), (0, 0, 0.26), 0.010, BRASS)
        shade = Material((0.88, 0.76, 0.56), (0.95, 0.88, 0.72), patterns.STRIPES, 0.05, glow=0.45)
        s.frustum((0, 0, 0.24), 0.13, 0.17, shade, taper=0.7)


def wardrobe(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A wardrobe 1.9 m wide and 2.1 m high with four doors."""
    door = Material(BIRCH.a, BIRCH.b, patterns.WOOD, 0.16, turned=True)
    with s.object("wardrobe", at, yaw):
        s.box((0, 0, 1.06), (1.90, 0.58, 2.08), OAK)
        for k in range(4):
            x = -0.7125 + 0.475 * k
            s.box((x, -0.30, 1.08), (0.46, 0.02, 1.98), door)
            s.rod((x + 0.17 * (-1) ** k, -0.325, 0.95), (x + 0.17 * (-1) ** k, -0.325, 1.20), 0.010, STEEL)


def chest(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A chest of four drawers, 1.0 m wide."""
    with s.object("chest of drawers", at, yaw):
        s.box((0, 0, 0.44), (1.00, 0.44, 0.84), WALNUT)
        for k in range(4):
            s.box((0, -0.225, 0.14 + 0.205 * k), (0.94, 0.015, 0.185), OAK)
            for x in (-0.25, 0.25):
                s.ball((x, -0.24, 0.14 + 0.205 * k), 0.015, BRASS)


def kitchen_counter(s: SceneBuilder, at: ArrayLike, yaw: float, length: float) -> None:
    """Base units ``length`` wide under a stone top, with a sink and a hob."""
    with s.object("kitchen counter", at, yaw):
        s.box((0, 0.03, 0.47), (length, 0.54, 0.78), _FRONT)
        s.box((0, 0.05, 0.04), (length, 0.48, 0.08), DARK)
        s.box((0, 0, 0.88), (length + 0.02, 0.62, 0.04), _STONE)
        count = round(length / 0.6)
        for k in range(count):
            x = (k + 0.5) * length / count - 0.5 * length
            s.box((x, -0.25, 0.45), (length / count - 0.02, 0.02, 0.70), OAK if k % 3 else _FRONT)
            s.rod((x - 0.12, -0.275, 0.74), (x + 0.12, -0.275, 0.74), 0.008, STEEL)
        s.box((-0.22 * length, 0, 0.902), (0.58, 0.46, 0.012), STEEL)
        s.box((-0.22 * length, -0.02, 0.91), (0.44, 0.32, 0.004), DARK)
        s.rod((-0.22 * length, 0.20, 0.90), (-0.22 * length, 0.20, 1.18), 0.014, STEEL)
        s.rod((-0.22 * length, 0.20, 1.17), (-0.22 * length, 0.02, 1.15), 0.012, STEEL)
        s.box((0.22 * length, 0, 0.904), (0.58, 0.50, 0.010), DARK)
        for x, y in ((-0.14, -0.11), (0.14, -0.11), (-0.14, 0.11), (0.14, 0.11)):
            s.frustum((0.22 * length + x, y, 0.909), 0.085, 0.003, STEEL)


def wall_cupboards(s: SceneBuilder, at: ArrayLike, yaw: float, length: float) -> None:
    """Cupboards ``length`` wide hanging over a counter; ``at``: the middle of their underside."""
    with s.object("wall cupboards", at, yaw):
        s.box((0, 0, 0.34), (length, 0.32, 0.68), _FRONT)
        count = round(length / 0.5)
        for k in range(count):
            x = (k + 0.5) * length / count - 0.5 * length
            s.box((x, -0.165, 0.34), (length / count - 0.015, 0.018, 0.65), OAK if k % 2 else _FRONT)
            s.ball((x + 0.18 * (-1) ** k, -0.185, 0.08), 0.014, STEEL)


def fridge(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A fridge 1.8 m high with notes under magnets."""
    with s.object("fridge", at, yaw):
        s.box((0, 0, 0.92), (0.60, 0.60, 1.80), WHITE)
        for z, high in ((0.40, 0.72), (1.28, 1.00)):
            s.box((0, -0.31, z), (0.58, 0.03, high), STEEL)
        for z in (0.55, 1.05):
            s.rod((0.23, -0.345, z), (0.23, -0.345, z + 0.20), 0.012, DARK)
        for k, (x, z, a) in enumerate(((-0.12, 1.45, 0.9), (0.06, 1.52, 0.5), (-0.02, 1.24, 0.7))):
            paper = Material((a, 0.85, 1.2 - a), (0.20, 0.24, 0.40), patterns.SCREEN, 0.02)
            s.box((x, -0.327, z), (0.11 + 0.02 * k, 0.004, 0.15), paper)


def kettle(s: SceneBuilder, at: ArrayLike) -> None:
    """A kettle with a handle and a spout."""
    with s.object("kettle", at):
        s.frustum((0, 0, 0), 0.085, 0.19, Material((0.60, 0.16, 0.14), (0.76, 0.26, 0.20)), taper=0.75)
        s.ball((0, 0, 0.20), 0.02, DARK)
        s.rod((0.07, 0, 0.17), (0.13, 0, 0.12), 0.012, DARK)
        s.rod((0.13, 0, 0.12), (0.08, 0, 0.03), 0.012, DARK)
        s.rod((-0.06, 0, 0.10), (-0.12, 0, 0.17), 0.018, STEEL, taper=0.6)


def bottles(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """Five bottles and jars in a row along x."""
    colours = (
        (0.30, 0.46, 0.20),
        (0.70, 0.44, 0.14),
        (0.84, 0.78, 0.60),
        (0.60, 0.18, 0.16),
        (0.3, 0.4, 0.6),
    )
    with s.object("bottles", at, yaw):
        for k, colour in enumerate(colours):
            body = Material(colour, tuple(0.5 + 0.5 * c for c in colour), patterns.STRIPES, 0.07)
            s.frustum((0.11 * k - 0.22, 0.01 * (k % 2), 0), 0.036, 0.14 + 0.04 * (k % 3), body)
            top = 0.14 + 0.04 * (k % 3)
            s.frustum((0.11 * k - 0.22, 0.01 * (k % 2), top), 0.020, 0.06, DARK if k % 2 else BRASS)


def dining_table(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A table for four, 1.4 x 0.8 m, with a runner."""
    with s.object("dining table", at, yaw):
        s.box((0, 0, 0.73), (1.40, 0.80, 0.035), OAK)
        s.box(
            (0, 0, 0.75),
            (1.42, 0.30, 0.006),
            Material((0.70, 0.30, 0.24), (0.90, 0.84, 0.70), patterns.RUG, 0.12),
        )
        for x in (-0.63, 0.63):
            for y in (-0.33, 0.33):
                s.rod((x, y, 0), (x, y, 0.72), 0.028, OAK, taper=1.3)


def chair(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A wooden chair with a cushion; one sits facing -y."""
    with s.object("chair", at, yaw):
        s.box((0, 0, 0.45), (0.42, 0.42, 0.03), WALNUT)
        s.box((0, -0.01, 0.475), (0.37, 0.36, 0.025), cloth((0.62, 0.42, 0.18), (0.82, 0.64, 0.36), 0.06))
        for x in (-0.18, 0.18):
            s.rod((x, -0.18, 0), (x, -0.18, 0.44), 0.018, WALNUT)
            s.rod((x, 0.19, 0), (x, 0.22, 0.92), 0.018, WALNUT)
        for z in (0.62, 0.76, 0.89):
            s.box((0, 0.215, z), (0.38, 0.02, 0.07), WALNUT)


def armchair(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """An armchair 0.85 m wide."""
    fabric = cloth((0.62, 0.38, 0.20), (0.80, 0.58, 0.34), 0.12)
    with s.object("armchair", at, yaw):
        s.box((0, 0, 0.22), (0.85, 0.80, 0.26), fabric)
        s.box((0, -0.05, 0.40), (0.58, 0.62, 0.12), fabric)
        s.box((0, 0.32, 0.62), (0.85, 0.18, 0.62), fabric, turn=(-8, 0, 0))
        for x in (-0.36, 0.36):
            s.box((x, 0, 0.45), (0.14, 0.80, 0.34), fabric)
        for x in (-0.36, 0.36):
            for y in (-0.34, 0.34):
                s.frustum((x, y, 0), 0.03, 0.10, WALNUT)


def television(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A 50-inch screen on its bench."""
    with s.object("television", at, yaw):
        s.box((0, 0, 0.24), (1.50, 0.40, 0.40), OAK)
        for x in (-0.48, 0.0, 0.48):
            s.box((x, -0.205, 0.24), (0.46, 0.015, 0.34), WALNUT)
        s.box((0, 0.05, 0.46), (0.40, 0.20, 0.02), DARK)
        s.box((0, 0.06, 0.52), (0.08, 0.04, 0.12), DARK)
        s.box((0, 0.05, 0.86), (1.12, 0.05, 0.64), DARK)
        picture = Material((0.30, 0.48, 0.66), (0.34, 0.42, 0.22), patterns.WINDOW, 0.3, glow=0.6)
        s.box((0, 0.02, 0.86), (1.08, 0.012, 0.60), picture)


def coat_rack(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A board with hooks on the wall and three coats; ``at``: on the floor below it."""
    colours: tuple[tuple[Colour, Colour], ...] = (
        ((0.16, 0.22, 0.34), (0.28, 0.36, 0.50)),
        ((0.58, 0.42, 0.24), (0.72, 0.56, 0.36)),
        ((0.46, 0.14, 0.16), (0.64, 0.26, 0.24)),
    )
    with s.object("coat rack", at, yaw):
        s.box((0, -0.015, 1.72), (1.10, 0.03, 0.12), WALNUT)
        for k, (a, b) in enumerate(colours):
            x = -0.36 + 0.36 * k
            s.rod((x, -0.03, 1.72), (x, -0.10, 1.75), 0.010, BRASS)
            s.ball((x, -0.12, 1.24), (0.15, 0.085, 0.46), cloth(a, b, 0.10))
            s.rod((x - 0.13, -0.13, 1.52), (x - 0.17, -0.14, 1.00), 0.045, cloth(a, b, 0.08))
            s.rod((x + 0.13, -0.13, 1.52), (x + 0.17, -0.14, 1.00), 0.045, cloth(a, b, 0.08))


def shoe_shelf(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A low shelf with three pairs of shoes on each of its two boards."""
    colours = (
        (0.20, 0.16, 0.14),
        (0.62, 0.24, 0.18),
        (0.30, 0.36, 0.52),
        (0.80, 0.78, 0.72),
        (0.4, 0.3, 0.2),
    )
    with s.object("shoe shelf", at, yaw):
        for z in (0.12, 0.36, 0.60):
            s.box((0, 0, z), (0.90, 0.28, 0.02), BIRCH)
        for x in (-0.44, 0.44):
            s.box((x, 0, 0.31), (0.02, 0.28, 0.60), BIRCH)
        for k in range(6):
            colour = colours[(3 * k) % 5]
            x, z = -0.28 + 0.28 * (k % 3), 0.13 + 0.24 * (k // 3)
            for side in (-0.055, 0.055):
                s.ball(
                    (x + side, 0, z + 0.04),
                    (0.042, 0.13, 0.045),
                    cloth(colour, tuple(1.2 * c for c in colour)),
                )


def curtain(s: SceneBuilder, at: ArrayLike, yaw: float, colour: Colour) -> None:
    """A gathered curtain 0.4 m wide from 2.3 m down to the floor."""
    fabric = cloth(tuple(0.8 * c for c in colour), colour, 0.15)
    with s.object("curtain", at, yaw):
        for k in range(5):
            s.frustum((0.08 * k - 0.16, 0.012 * (-1) ** k, 0.03), 0.05, 2.27, fabric, taper=0.8)


def door_leaf(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """An open door, 0.85 m from its hinge at ``at`` along +x."""
    leaf = Material((0.66, 0.56, 0.42), (0.80, 0.71, 0.56), patterns.WOOD, 0.18, turned=True)
    panel = Material(leaf.b, leaf.a, patterns.WOOD, 0.14, turned=True)
    with s.object("door", at, yaw):
        s.box((0.43, 0, 1.03), (0.85, 0.04, 2.02), leaf)
        for y in (-0.022, 0.022):
            for z in (0.55, 1.50):
                s.box((0.43, y, z), (0.55, 0.008, 0.70), panel)
            s.rod((0.78, 2 * y, 1.02), (0.66, 2 * y, 1.02), 0.011, BRASS)


def ceiling_lamp(s: SceneBuilder, at: ArrayLike, drop: float = 0.0) -> None:
    """A round lamp under the ceiling at ``at``, hanging ``drop`` below it."""
    glass = Material((0.93, 0.90, 0.80), (0.98, 0.96, 0.90), glow=0.8)
    with s.object("ceiling lamp", at):
        if drop > 0.0:
            s.rod((0, 0, 0), (0, 0, -drop), 0.006, DARK)
        s.frustum((0, 0, -drop - 0.10), 0.20, 0.10, glass, taper=0.6)


def wall_lamp(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A lamp on an arm; ``at``: where the arm leaves the wall."""
    shade = Material((0.90, 0.82, 0.66), (0.96, 0.91, 0.80), glow=0.5)
    with s.object("wall lamp", at, yaw):
        s.box((0, -0.01, 0), (0.10, 0.02, 0.16), BRASS)
        s.rod((0, -0.02, 0), (0, -0.14, 0.04), 0.010, BRASS)
        s.frustum((0, -0.15, -0.04), 0.085, 0.15, shade, taper=0.65)


def basket(s: SceneBuilder, at: ArrayLike) -> None:
    """A woven basket with laundry."""
    weave = Material((0.56, 0.40, 0.22), (0.78, 0.62, 0.40), patterns.CHECKER, 0.03)
    with s.object("basket", at):
        s.frustum((0, 0, 0), 0.19, 0.42, weave, taper=1.15)
        for x, y, a in ((-0.07, 0.02, 0.8), (0.08, 0.05, 0.4), (0.0, -0.08, 0.6)):
            s.ball((x, y, 0.42), (0.13, 0.11, 0.07), cloth((a, 0.5, 1.0 - a), (1.1 * a, 0.6, 1.1 - a), 0.05))


def vase(s: SceneBuilder, at: ArrayLike) -> None:
    """A vase with dry branches."""
    clay = Material((0.70, 0.66, 0.58), (0.34, 0.42, 0.48), patterns.MARBLE, 0.09)
    with s.object("vase", at):
        s.ball((0, 0, 0.12), (0.08, 0.08, 0.12), clay)
        s.frustum((0, 0, 0.20), 0.03, 0.07, clay, taper=1.4)
        for k in range(4):
            tip = np.array([0.10 * np.cos(1.7 * k), 0.10 * np.sin(1.7 * k), 0.50 + 0.04 * (k % 3)])
            s.rod((0, 0, 0.24), tip, 0.006, WALNUT)
            s.ball(tip, (0.04, 0.04, 0.03), LEAF if k % 2 else cloth((0.7, 0.3, 0.3), (0.86, 0.46, 0.40)))
