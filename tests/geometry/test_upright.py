# SPDX-License-Identifier: Apache-2.0
"""Up is found from rooms and paths whose up is known, however their world is turned."""

from __future__ import annotations

import numpy as np
import pytest

from ggwarp.datasets.built_in.scene import looking
from ggwarp.geometry import se3
from ggwarp.geometry.upright import CONVENTIONS, estimate_up, given_up, levelled, rotation_to

Z = np.array([0.0, 0.0, 1.0])
NONE = np.zeros((0, 3)), np.zeros(0)


def poses(headings, pitches, rolls=0.0, *, seed: int = 0) -> np.ndarray:
    """Cameras in a world with z up, held by hand: angles in degrees, and a few degrees of unrest."""
    rng = np.random.default_rng(seed)
    out = []
    for angles in zip(*np.broadcast_arrays(headings, pitches, rolls), strict=True):
        T_wc = np.eye(4)
        T_wc[:3, :3] = looking(*np.radians(angles + rng.normal(0.0, 2.0, 3)))
        T_wc[:3, 3] = rng.normal(size=3)
        out.append(T_wc)
    return np.stack(out)


def room(*, level: int, upright: int, stray: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Normals of floors, of walls in two directions, and of what is neither; areas of 1."""
    rng = np.random.default_rng(seed)
    walls = np.where(rng.random((upright, 1)) < 0.7, [[0.8, 0.6, 0.0]], [[-0.6, 0.8, 0.0]])
    normals = np.concatenate([np.tile(Z, (level, 1)), walls]) + rng.normal(0.0, 0.03, (level + upright, 3))
    normals = np.concatenate([normals, rng.normal(size=(stray, 3))])
    normals *= rng.choice([-1.0, 1.0], (len(normals), 1))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True), np.ones(len(normals))


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


WALK = np.linspace(0.0, 250.0, 40)


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [2.0, -1.0, 0.5], [0.0, np.pi, 0.0]])
def test_a_room_is_upright_to_half_a_degree_however_the_world_is_turned(turn) -> None:
    R = se3.so3_exp(turn)
    T = np.eye(4)
    T[:3, :3] = R
    normals, areas = room(level=300, upright=300, stray=200)
    found = estimate_up(T @ poses(WALK, -20.0), normals @ R.T, areas)
    assert found.source == "surfaces" and found.support is not None and found.support > 0.7
    assert angle(found.direction, R @ Z) < 0.5


def test_walls_alone_say_what_is_up() -> None:
    normals, areas = room(level=0, upright=400, stray=50)
    assert angle(estimate_up(poses(WALK, -10.0), normals, areas).direction, Z) < 0.7


@pytest.mark.parametrize("pitch", [-35.0, 20.0])
def test_one_direction_and_a_pitch_are_enough_with_surfaces(pitch: float) -> None:
    """All frames look the same way, so that the camera alone would take its pitch for level."""
    normals, areas = room(level=300, upright=300, stray=200)
    assert angle(estimate_up(poses(np.full(20, 30.0), pitch), normals, areas).direction, Z) < 0.7


def test_without_surfaces_the_camera_is_believed() -> None:
    found = estimate_up(poses(WALK, -30.0), *NONE)
    assert found.source == "camera" and found.support is None
    assert angle(found.direction, Z) < 4.0


def test_surfaces_of_all_directions_say_nothing() -> None:
    normals, areas = room(level=0, upright=0, stray=3000)
    found = estimate_up(poses(WALK, -30.0), normals, areas)
    assert found.source == "camera" and angle(found.direction, Z) < 4.0


def test_frames_that_roll_are_outvoted() -> None:
    rolls = np.where(np.arange(40) % 4 == 0, 80.0, 0.0)
    assert angle(estimate_up(poses(WALK, -15.0, rolls), *NONE).direction, Z) < 8.0


@pytest.mark.parametrize("roll", [90.0, -90.0])
def test_pictures_of_a_telephone_held_upright(roll: float) -> None:
    normals, areas = room(level=300, upright=300, stray=200)
    assert angle(estimate_up(poses(WALK, -15.0, roll), normals, areas).direction, Z) < 0.7


def test_one_pose_that_is_level_is_its_own_up() -> None:
    assert angle(estimate_up(np.eye(4)[None], *NONE).direction, np.array([0.0, -1.0, 0.0])) < 1e-6


def test_a_given_direction_is_taken_as_it_is() -> None:
    assert given_up([0.0, -3.0, 0.0]).direction.tolist() == [0.0, -1.0, 0.0]
    for nonsense in ([0.0, 0.0, 0.0], [1.0, 2.0], [np.nan, 0.0, 1.0]):
        with pytest.raises(ValueError, match="three numbers"):
            given_up(nonsense)


def test_a_level_pose_looks_the_same_way() -> None:
    T_wc = poses([40.0], [-20.0], [35.0])[0]
    level = levelled(T_wc, Z)
    assert np.allclose(level[:3, 2:], T_wc[:3, 2:]) and level[:3, 0] @ Z == pytest.approx(0.0, abs=1e-12)
    assert level[:3, 1] @ Z < 0.0 and np.linalg.det(level[:3, :3]) == pytest.approx(1.0)
    down = np.eye(4)
    down[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    assert levelled(down, Z) is down


@pytest.mark.parametrize(
    ("convention", "up", "ahead"),
    [("y-down", [0, -1, 0], [0, 0, 1]), ("y-up", [0, 1, 0], [0, 0, -1]), ("z-up", [0, 0, 1], [0, 1, 0])],
)
def test_other_programs_axes(convention: str, up: list[int], ahead: list[int]) -> None:
    R = rotation_to(convention, Z, np.array([0.6, 0.8, -0.3]))
    assert np.allclose(R @ Z, up) and np.allclose(R @ [0.6, 0.8, 0.0], ahead)
    assert np.linalg.det(R) == pytest.approx(1.0)
    straight_down = rotation_to(convention, Z, -Z)
    assert np.allclose(straight_down @ Z, up) and np.linalg.det(straight_down) == pytest.approx(1.0)


def test_every_convention_is_a_rotation() -> None:
    for axes in CONVENTIONS.values():
        assert np.allclose(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) == pytest.approx(1.0)
