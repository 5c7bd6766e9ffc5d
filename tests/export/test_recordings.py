# SPDX-License-Identifier: Apache-2.0
"""Runs as recordings for other programs: poses and pictures as another reader finds them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from ggwarp.datasets import open_dataset
from ggwarp.editing.map_view import MapView
from ggwarp.export.__main__ import main
from ggwarp.export.film import orbit, seen_sides
from ggwarp.export.scene import prepare
from ggwarp.geometry import se3
from ggwarp.geometry.upright import given_up, rotation_to
from ggwarp.io.trajectory import read_tum
from ggwarp.results.saved_run import load_run
from small_run import CAMERA, decibels, write_small_run


def exported(run_folder: Path, kind: str) -> Path:
    assert main([str(run_folder), "--up", "-y", "--to", kind, "--rendered"]) == 0
    return run_folder / "export" / kind


@pytest.mark.parametrize(("kind", "convention"), [("colmap", "y-down"), ("nerfstudio", "z-up")])
def test_it_is_opened_as_a_recording(run_folder: Path, scene, kind: str, convention: str) -> None:
    dataset = open_dataset(str(exported(run_folder, kind)), data_root=run_folder)
    _, poses = read_tum(run_folder / "trajectory.txt")
    assert len(dataset) == len(poses)
    camera = dataset.camera
    assert (camera.width, camera.height) == (96, 64)
    assert np.allclose([camera.fx, camera.fy, camera.cx, camera.cy], [80.0, 80.0, 47.5, 31.5], atol=1e-6)
    T = np.eye(4)
    T[:3, :3] = rotation_to(convention, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    for index in (0, 2):
        frame = dataset.load(index) if hasattr(dataset, "load") else dataset[index]
        assert frame.T_wc is not None
        between = se3.inverse(T @ poses[index]) @ frame.T_wc
        assert np.allclose(between, np.eye(4), atol=1e-5)
        seen = MapView(scene, CAMERA).render(poses[index])
        assert decibels(frame.rgb / 255.0, seen.rgb) > 40.0
        if kind == "nerfstudio":
            assert frame.depth is not None
            assert np.abs(frame.depth - seen.surface_depth).max() < 0.002


def test_pycolmap_reads_it(run_folder: Path, scene) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    folder = exported(run_folder, "colmap")
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert len(model.images) == 5 and len(model.points3D) == int((scene.opacity_logits > 0.0).sum())
    # A point of the map projects to where the picture has its colour.
    red = scene.means[(scene.object_ids == 5) & (scene.means[:, 2] < 1.81)].mean(axis=0)
    for number, image in model.images.items():
        if number == 5:
            continue
        u, v = model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * red)
        picture = cv2.imread(str(folder / "images" / image.name))
        b, g, r = picture[int(v), int(u)].astype(int)
        assert r > 2 * g and r > 2 * b


def test_a_film_shows_the_path(run_folder: Path, scene) -> None:
    assert main([str(run_folder), "--up", "-y", "--to", "film"]) == 0
    film = Image.open(run_folder / "export" / "map.webp")
    assert (film.n_frames, film.size) == (5, (96, 64))  # type: ignore[attr-defined]
    _, poses = read_tum(run_folder / "trajectory.txt")
    for number in (0, 3):
        film.seek(number)
        seen = MapView(scene, CAMERA).render(poses[number]).rgb
        assert decibels(np.asarray(film.convert("RGB")) / 255.0, seen) > 25.0


def test_an_orbit_turns_about_an_object_upright(run_folder: Path) -> None:
    assert main([str(run_folder), "--up", "-y", "--to", "orbit", "--objects", "5", "--every", "30"]) == 0
    film = Image.open(run_folder / "export" / "5.orbit.webp")
    assert (film.n_frames, film.size) == (4, (96, 64))  # type: ignore[attr-defined]
    for number in range(4):
        film.seek(number)
        red = np.asarray(film.convert("RGB"))[..., 0] > 100
        rows, columns = np.nonzero(red)
        # The cube is in the middle, whole, from each side.
        assert abs(rows.mean() - 31.5) < 6.0 and abs(columns.mean() - 47.5) < 6.0
        assert 1000 < red.sum() < 4000 and not (red[0].any() or red[-1].any())


def test_an_orbit_looks_past_the_outer_side_of_a_wall(scene, tmp_path: Path) -> None:
    wall = scene.object_ids == 1
    thin = np.where(wall[:, None] & np.array([False, False, True]), np.log(0.003), scene.log_scales)
    level = np.tile(np.float32([1.0, 0.0, 0.0, 0.0]), (len(scene), 1))
    flat = replace(scene, log_scales=thin.astype(np.float32), quats=level)
    folder = write_small_run(tmp_path / "flat", flat)
    run = load_run(folder)
    assert (seen_sides(flat, run.poses)[wall, 2] < -0.99).all()
    prepared = prepare(run, names=[], convention="world", up=given_up([0.0, -1.0, 0.0]))
    poses = orbit(flat, prepared)
    assert len(poses) == 120
    for T_wc in poses[::20]:
        assert np.allclose(T_wc[:3, :3].T @ T_wc[:3, :3], np.eye(3)) and np.linalg.det(T_wc[:3, :3]) > 0.0
        assert abs(T_wc[1, 0]) < 1e-9 and T_wc[1, 1] > 0.5  # level, and upright
        pixels, front = CAMERA.project(se3.transform_points(se3.inverse(T_wc), flat.means))
        inside = ((pixels > -0.5) & (pixels < (95.5, 63.5))).all(axis=1)
        assert front.all() and inside.mean() > 0.99
    assert main([str(folder), "--up", "-y", "--to", "orbit", "--every", "60"]) == 0
    film = Image.open(folder / "export" / "map.orbit.webp")
    lit = []
    for number in range(2):
        film.seek(number)
        lit.append(int((np.asarray(film.convert("RGB")).max(axis=2) > 60).sum()))
    # From in front of the wall and from behind it, where only the cubes are left.
    assert lit[0] > 3 * lit[1] > 0


def test_rerun_log_is_written_with_every_frame(run_folder: Path) -> None:
    pytest.importorskip("rerun")
    assert main([str(run_folder), "--up", "-y", "--to", "rrd"]) == 0
    data = (run_folder / "export" / "map.rrd").read_bytes()
    assert data[:3] == b"RRF"
    for entity in (b"world/map", b"world/camera", b"world/objects/5", b"world/path"):
        assert entity in data
