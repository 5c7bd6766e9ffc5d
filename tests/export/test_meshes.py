# SPDX-License-Identifier: Apache-2.0
"""Meshes of maps: where the surface is, which way it faces, whose it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggwarp.export.__main__ import main
from ggwarp.export.tsdf import TsdfVolume
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.upright import rotation_to
from small_run import read_accessor, read_glb

CAMERA = Camera(120, 90, 90.0, 90.0, 59.5, 44.5)
R_Z_UP = rotation_to("z-up", np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))


def sphere_depth(radius: float, away: float) -> np.ndarray:
    """Depth of a ball on the optical axis, metres; 0 beside it."""
    rays = CAMERA.rays(*np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)))
    a, b, c = (rays**2).sum(-1), -2.0 * away * rays[..., 2], away**2 - radius**2
    inside = b**2 - 4.0 * a * c
    return np.where(inside > 0.0, (-b - np.sqrt(np.maximum(inside, 0.0))) / (2.0 * a), 0.0).astype(np.float32)


def test_a_ball_seen_from_six_sides_becomes_a_ball() -> None:
    radius, away = 0.3, 1.0
    depth, red = sphere_depth(radius, away), np.tile(np.float32([0.8, 0.1, 0.2]), (90, 120, 1))
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    volume = TsdfVolume((radius * directions).astype(np.float32), voxel=0.01, device="cpu")
    for forward in directions:
        T_wc = np.eye(4)
        x = np.roll(forward, 1)
        T_wc[:3, :3] = np.stack([x, np.cross(forward, x), forward], axis=1)
        T_wc[:3, 3] = -away * forward
        volume.add(depth, red, T_wc, CAMERA)
    mesh = volume.surface()
    distance = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(distance - radius).max() < 0.01 and np.abs(distance - radius).mean() < 0.003
    outwards = mesh.vertices / distance[:, None]
    agreement = (mesh.normals * outwards).sum(1)
    assert agreement.mean() > 0.98 and np.percentile(agreement, 5.0) > 0.9
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    winding = np.cross(b - a, c - a)
    assert ((winding * a).sum(1) > -1e-9).mean() > 0.999, "counter-clockwise from outside"
    assert 0.5 * np.linalg.norm(winding, axis=1).sum() == pytest.approx(4.0 * np.pi * radius**2, rel=0.03)
    assert np.allclose(mesh.colours, [0.8, 0.1, 0.2], atol=1e-3)


def test_images_of_nothing_give_no_surface() -> None:
    volume = TsdfVolume(np.zeros((4, 3), np.float32), voxel=0.01, device="cpu")
    volume.add(np.zeros((90, 120), np.float32), np.zeros((90, 120, 3), np.float32), np.eye(4), CAMERA)
    assert not len(volume.surface().faces)


@pytest.fixture
def meshes(run_folder: Path) -> Path:
    assert main([str(run_folder), "--up", "-y", "--to", "glb,mesh", "--voxel", "0.03"]) == 0
    return run_folder / "export"


def test_the_wall_is_where_it_was_and_upright(meshes: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(meshes / "map.mesh.ply", process=False)
    at = np.asarray(mesh.vertices) @ R_Z_UP  # back to the run's world
    ids = mesh.metadata["_ply_raw"]["face"]["data"]["object_id"]
    wall = np.unique(mesh.faces[ids.ravel() == 1])
    assert np.abs(at[wall, 2] - 3.0).mean() < 0.03
    facing = np.asarray(mesh.face_normals)[ids.ravel() == 1] @ R_Z_UP
    assert facing[:, 2].mean() < -0.8, "towards the cameras"


def test_objects_are_nodes_with_names_and_their_own_colours(meshes: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.load(meshes / "map.glb", process=False)
    assert set(scene.geometry) >= {"wall", "cube"} and len(scene.geometry) == 3
    document, binary = read_glb(meshes / "map.glb")
    node = next(n for n in document["nodes"] if n["extras"] == {"object_id": 5})
    red = document["meshes"][node["mesh"]]["primitives"][0]
    colours = read_accessor(document, binary, red["attributes"]["COLOR_0"])
    assert np.allclose(np.median(colours, axis=0), [202, 3, 3, 255], atol=12), "0.9, 0.1, 0.1 as linear light"
    y_up = scene.geometry["cube"].vertices @ rotation_to(
        "y-up", np.array([0.0, -1, 0]), np.array([0.0, 0, 1])
    )
    assert np.allclose(np.median(y_up, axis=0)[:2], [-0.3, 0.0], atol=0.1)


def test_an_object_alone_is_a_mesh_too(run_folder: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    options = ["--to", "glb", "--objects", "8", "--axes", "world", "--voxel", "0.02"]
    assert main([str(run_folder), "--up", "-y", *options]) == 0
    scene = trimesh.load(run_folder / "export" / "8.glb", process=False)
    (cube,) = scene.geometry.values()
    # Its front is seen, its back is not; half sizes 0.15 and Gaussians of 0.03.
    low, high = cube.bounds
    assert np.allclose((low + high)[:2] / 2.0, [0.5, 0.1], atol=0.04) and np.all((high - low)[:2] < 0.45)
