# SPDX-License-Identifier: Apache-2.0
"""Furniture of the built-in rooms: each function adds one object (an id of its own).

Sizes are those of real things, metres. An object faces -y in its own frame before ``yaw``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ggwarp.datasets.built_in.scene import Colour, Material, SceneBuilder
from ggwarp.geometry.se3 import so3_exp, so3_log
from ggwarp.kernels.scene import procedural as patterns

OAK = Material((0.46, 0.30, 0.17), (0.80, 0.60, 0.38), patterns.WOOD, 0.12)
WALNUT = Material((0.24, 0.14, 0.09), (0.50, 0.33, 0.21), patterns.WOOD, 0.10)
BIRCH = Material((0.70, 0.58, 0.42), (0.92, 0.83, 0.68), patterns.WOOD, 0.15)
STEEL = Material((0.50, 0.52, 0.55), (0.66, 0.68, 0.71), scale=0.10)
DARK = Material((0.13, 0.13, 0.15), (0.24, 0.24, 0.27), scale=0.08)
WHITE = Material((0.72, 0.72, 0.70), (0.84, 0.84, 0.82), scale=0.25)
LEAF = Material((0.13, 0.30, 0.12), (0.36, 0.58, 0.24), scale=0.10)
BRASS = Material((0.62, 0.48, 0.22), (0.80, 0.66, 0.36), scale=0.08)


def cloth(a: Colour, b: Colour, scale: float = 0.12) -> Material:
    """A mottled fabric."""
    return Material(a, b, scale=scale)


def desk(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A desk 1.6 m wide: top, four legs, drawers, a modesty panel."""
    with s.object("desk", at, yaw):
        s.box((0, 0, 0.725), (1.60, 0.75, 0.03), OAK)
        for x, y in ((-0.75, -0.33), (0.75, -0.33), (-0.75, 0.33), (0.75, 0.33)):
            s.box((x, y, 0.355), (0.05, 0.05, 0.71), DARK)
        s.box((0, 0.32, 0.52), (1.45, 0.02, 0.30), OAK)
        s.box((0.50, 0.02, 0.38), (0.42, 0.60, 0.55), WALNUT)
        for z in (0.20, 0.38, 0.56):
            s.box((0.50, -0.285, z), (0.38, 0.02, 0.16), OAK)
            s.rod((0.42, -0.31, z), (0.58, -0.31, z), 0.010, STEEL)


def monitor(s: SceneBuilder, at: ArrayLike, yaw: float, a: Colour, b: Colour) -> None:
    """A 24-inch screen on its stand, showing text."""
    with s.object("monitor", at, yaw):
        s.frustum((0, 0.04, 0), 0.11, 0.015, DARK)
        s.box((0, 0.05, 0.14), (0.05, 0.02, 0.28), DARK)
        s.box((0, 0.02, 0.33), (0.56, 0.035, 0.34), DARK)
        s.box((0, 0.0, 0.335), (0.53, 0.012, 0.30), Material(a, b, patterns.SCREEN, 0.025, glow=0.6))


def keyboard(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A keyboard with a checkered field of keys."""
    with s.object("keyboard", at, yaw):
        s.box((0, 0, 0.010), (0.44, 0.15, 0.020), DARK)
        s.box(
            (0, 0, 0.022),
            (0.42, 0.13, 0.008),
            Material((0.75,) * 3, (0.35, 0.36, 0.40), patterns.CHECKER, 0.02),
        )


def mouse(s: SceneBuilder, at: ArrayLike) -> None:
    """A mouse on its pad."""
    with s.object("mouse", at):
        s.box((0, 0, 0.003), (0.20, 0.22, 0.006), cloth((0.14, 0.30, 0.42), (0.25, 0.48, 0.60), 0.06))
        s.ball((0, 0, 0.015), (0.032, 0.055, 0.024), DARK)


def mug(s: SceneBuilder, at: ArrayLike, a: Colour, b: Colour) -> None:
    """A striped mug with a handle."""
    with s.object("mug", at):
        s.frustum((0, 0, 0), 0.042, 0.10, Material(a, b, patterns.STRIPES, 0.05), taper=1.05)
        for start, end in (
            ((0.04, 0, 0.08), (0.075, 0, 0.075)),
            ((0.075, 0, 0.075), (0.075, 0, 0.03)),
            ((0.075, 0, 0.03), (0.04, 0, 0.02)),
        ):
            s.rod(start, end, 0.007, cloth(a, a))


def desk_lamp(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A jointed lamp with a conical shade."""
    red = Material((0.70, 0.16, 0.12), (0.86, 0.28, 0.20), scale=0.1)
    with s.object("desk lamp", at, yaw):
        s.frustum((0, 0, 0), 0.09, 0.025, red)
        s.rod((0, 0, 0.02), (0.10, 0, 0.30), 0.009, STEEL)
        s.rod((0.10, 0, 0.30), (-0.12, -0.06, 0.48), 0.009, STEEL)
        s.frustum((-0.16, -0.07, 0.36), 0.095, 0.13, red, taper=0.35)


def pencils(s: SceneBuilder, at: ArrayLike) -> None:
    """A cup with five pencils."""
    with s.object("pencil cup", at):
        s.frustum((0, 0, 0), 0.04, 0.10, Material((0.22, 0.42, 0.40), (0.40, 0.62, 0.58), scale=0.05))
        for k in range(5):
            turn = 1.257 * k
            tip = np.array([0.045 * np.cos(turn), 0.045 * np.sin(turn), 0.17 + 0.012 * (k % 3)])
            colour = ((0.85, 0.65, 0.15), (0.75, 0.2, 0.2), (0.2, 0.35, 0.7), (0.2, 0.55, 0.3), (0.6,) * 3)[k]
            s.rod((0.3 * tip[0], 0.3 * tip[1], 0.02), tip, 0.006, cloth(colour, colour))


def office_chair(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A swivel chair: star foot with castors, post, seat, back, arms."""
    fabric = cloth((0.10, 0.24, 0.40), (0.22, 0.42, 0.60), 0.10)
    with s.object("office chair", at, yaw):
        for k in range(5):
            c, d = np.cos(1.2566 * k), np.sin(1.2566 * k)
            s.rod((0, 0, 0.12), (0.30 * c, 0.30 * d, 0.07), 0.022, DARK, taper=0.6)
            s.ball((0.30 * c, 0.30 * d, 0.032), 0.032, DARK)
        s.frustum((0, 0, 0.08), 0.028, 0.36, STEEL)
        s.box((0, 0, 0.47), (0.48, 0.46, 0.07), fabric)
        s.box((0, 0.24, 0.60), (0.06, 0.03, 0.30), DARK)
        s.box((0, 0.235, 0.80), (0.44, 0.055, 0.42), fabric, turn=(-6, 0, 0))
        for x in (-0.26, 0.26):
            s.box((x, 0.02, 0.66), (0.05, 0.28, 0.03), DARK)
            s.box((x, 0.08, 0.56), (0.03, 0.04, 0.20), DARK)


def bookshelf(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """An open shelf 1.1 x 1.9 m with five boards."""
    with s.object("bookshelf", at, yaw):
        for x in (-0.54, 0.54):
            s.box((x, 0, 0.95), (0.025, 0.30, 1.90), WALNUT)
        s.box((0, 0.14, 0.95), (1.06, 0.012, 1.88), WALNUT)
        for z in (0.05, 0.42, 0.79, 1.16, 1.53, 1.89):
            s.box((0, 0, z), (1.06, 0.30, 0.024), WALNUT)


def books(s: SceneBuilder, at: ArrayLike, yaw: float, count: int, seed: int) -> None:
    """A row of standing books along x from ``at``, the last one leaning."""
    rng = np.random.default_rng(seed)
    with s.object("books", at, yaw):
        x = 0.0
        for k in range(count):
            thick, high, deep = rng.uniform(0.025, 0.055), rng.uniform(0.20, 0.29), rng.uniform(0.15, 0.21)
            base = 0.25 + 0.5 * rng.random(3) * np.array([1.0, 0.8, 0.9])
            ink = np.clip(base + (0.35 if base.mean() < 0.5 else -0.35), 0.05, 0.95)
            cover = Material(tuple(base), tuple(ink), patterns.SPINES, 0.10)
            if k == count - 1:
                s.box((x + 0.06, 0, 0.5 * high), (thick, deep, high * 0.97), cover, turn=(0, 14, 0))
            else:
                s.box((x + 0.5 * thick, 0, 0.5 * high), (thick, deep, high), cover)
            x += thick + 0.002


def book_stack(s: SceneBuilder, at: ArrayLike, yaw: float, seed: int) -> None:
    """Four books lying on each other."""
    rng = np.random.default_rng(seed)
    with s.object("book stack", at, yaw):
        z = 0.0
        for _ in range(4):
            thick = rng.uniform(0.025, 0.045)
            base = 0.2 + 0.6 * rng.random(3)
            cover = Material(tuple(base), tuple(0.3 + 0.6 * rng.random(3)), patterns.POSTER, 0.07)
            turn = (0, 0, rng.uniform(-14, 14))
            s.box((0, 0, z + 0.5 * thick), (0.24, 0.17, thick), cover, turn=turn)
            z += thick


def sofa(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A two-seat sofa 1.7 m wide."""
    fabric = cloth((0.34, 0.40, 0.36), (0.56, 0.62, 0.56), 0.16)
    with s.object("sofa", at, yaw):
        s.box((0, 0, 0.20), (1.70, 0.80, 0.24), fabric)
        for x in (-0.36, 0.36):
            s.box((x, -0.04, 0.38), (0.70, 0.68, 0.13), fabric)
        s.box((0, 0.33, 0.58), (1.70, 0.18, 0.56), fabric, turn=(-8, 0, 0))
        for x in (-0.80, 0.80):
            s.box((x, 0, 0.42), (0.14, 0.80, 0.40), fabric)
        for x in (-0.78, 0.78):
            for y in (-0.35, 0.35):
                s.frustum((x, y, 0), 0.03, 0.09, WALNUT)


def cushion(s: SceneBuilder, at: ArrayLike, yaw: float, material: Material) -> None:
    """A cushion leaning back."""
    with s.object("cushion", at, yaw):
        s.ball((0, 0, 0.19), (0.22, 0.085, 0.20), material, turn=(-18, 0, 0))


def coffee_table(s: SceneBuilder, at: ArrayLike) -> None:
    """A round table on a conical foot."""
    with s.object("coffee table", at):
        s.frustum((0, 0, 0.40), 0.40, 0.03, Material(BIRCH.a, BIRCH.b, patterns.WOOD, 0.10))
        s.frustum((0, 0, 0.02), 0.10, 0.38, WALNUT, taper=0.4)
        s.frustum((0, 0, 0), 0.24, 0.02, WALNUT)


def fruit_bowl(s: SceneBuilder, at: ArrayLike) -> None:
    """A bowl of oranges and an apple."""
    orange = Material((0.86, 0.42, 0.08), (0.96, 0.62, 0.18), scale=0.05)
    apple = Material((0.62, 0.12, 0.10), (0.74, 0.60, 0.20), scale=0.08)
    with s.object("fruit bowl", at):
        s.frustum(
            (0, 0, 0),
            0.07,
            0.07,
            Material((0.20, 0.36, 0.52), (0.86,) * 3, patterns.STRIPES, 0.03),
            taper=1.9,
        )
        for x, y, fruit in (
            (-0.05, 0.03, orange),
            (0.045, 0.045, orange),
            (0.0, -0.06, apple),
            (0.06, -0.03, orange),
        ):
            s.ball((x, y, 0.092), 0.040, fruit)


def cabinet(s: SceneBuilder, at: ArrayLike, yaw: float) -> None:
    """A sideboard 1.1 m wide with two doors."""
    with s.object("cabinet", at, yaw):
        s.box((0, 0, 0.42), (1.10, 0.45, 0.72), BIRCH)
        for x in (-0.27, 0.27):
            s.box(
                (x, -0.23, 0.42),
                (0.52, 0.02, 0.66),
                Material(BIRCH.a, BIRCH.b, patterns.WOOD, 0.13, turned=True),
            )
            s.ball((0.22 * x, -0.255, 0.46), 0.016, BRASS)
        for x in (-0.50, 0.50):
            for y in (-0.18, 0.18):
                s.frustum((x, y, 0), 0.022, 0.06, DARK)


def picture(
    s: SceneBuilder, name: str, at: ArrayLike, yaw: float, size: tuple[float, float], print_: Material
) -> None:
    """A framed picture hanging at ``at`` (its middle)."""
    with s.object(name, at, yaw):
        s.box((0, -0.012, 0), (size[0] + 0.06, 0.024, size[1] + 0.06), DARK)
        s.box((0, -0.022, 0), (size[0], 0.012, size[1]), print_)


def window(s: SceneBuilder, at: ArrayLike, yaw: float = 0.0) -> None:
    """A window 1.5 m wide with a sill; ``at``: its middle."""
    with s.object("window", at, yaw):
        view = Material((0.56, 0.72, 0.92), (0.30, 0.42, 0.26), patterns.WINDOW, 0.3, glow=0.75)
        s.box((0, -0.004, 0), (1.40, 0.01, 1.10), view)
        for x in (-0.72, 0.0, 0.72):
            s.box((x, -0.025, 0), (0.06, 0.05, 1.20), WHITE)
        for z in (-0.58, 0.58):
            s.box((0, -0.025, z), (1.50, 0.05, 0.06), WHITE)
        s.box((0, -0.09, -0.62), (1.60, 0.18, 0.03), BIRCH)


def radiator(s: SceneBuilder, at: ArrayLike, yaw: float = 0.0) -> None:
    """A radiator 1.2 m wide; ``at``: the middle of its foot."""
    with s.object("radiator", at, yaw):
        for k in range(8):
            s.box((-0.56 + 0.16 * k, 0, 0.30), (0.06, 0.09, 0.60), WHITE)
        for z in (0.06, 0.54):
            s.rod((-0.60, 0, z), (0.60, 0, z), 0.02, WHITE)


def floor_lamp(s: SceneBuilder, at: ArrayLike) -> None:
    """A standing lamp with a shade."""
    with s.object("floor lamp", at):
        s.frustum((0, 0, 0), 0.15, 0.03, DARK)
        s.rod((0, 0, 0.03), (0, 0, 1.45), 0.012, BRASS)
        s.frustum(
            (0, 0, 1.40), 0.21, 0.28, Material((0.90, 0.80, 0.58), (0.96, 0.90, 0.74), glow=0.4), taper=0.6
        )


def potted_plant(s: SceneBuilder, at: ArrayLike) -> None:
    """A plant of nine drooping leaves, 1.4 m high, in a pot."""
    with s.object("potted plant", at):
        s.frustum((0, 0, 0), 0.15, 0.30, Material((0.58, 0.32, 0.20), (0.74, 0.46, 0.32)), taper=1.3)
        s.rod((0, 0, 0.28), (0.02, -0.02, 0.95), 0.02, WALNUT)
        for k in range(9):
            a, up = 2.4 * k, 0.62 + 0.09 * k
            at = (0.20 * np.cos(a), 0.20 * np.sin(a), up)
            turn = _leaf_turn(a, 35.0)
            s.ball(at, (0.20, 0.075, 0.018), LEAF, turn=turn)


def _leaf_turn(a: float, droop: float) -> tuple[float, float, float]:
    """Rotation vector, degrees, of a leaf that points along azimuth ``a`` and droops."""
    w = so3_log(so3_exp([0, 0, a]) @ so3_exp([0, np.radians(droop), 0]))
    return tuple(np.degrees(w))
