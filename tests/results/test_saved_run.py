# SPDX-License-Identifier: Apache-2.0
"""A run folder opens whatever the run learnt."""

from pathlib import Path

import numpy as np
import pytest

import ggwarp
from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import write_camera
from ggwarp.map.gaussians import Gaussians
from ggwarp.results import run_folder
from ggwarp.results.saved_run import RunError, load_run, save_run

CAMERA = Camera(32, 24, 25.0, 25.0, 15.5, 11.5)


def _gaussians(n: int, ids: list[int] | None) -> Gaussians:
    values = np.arange(3 * n, dtype=np.float32).reshape(n, 3)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    return Gaussians(
        values, quats, values, values[:, 0], values, None if ids is None else np.array(ids, np.int32)
    )


@pytest.fixture
def folder(record, tmp_path: Path) -> Path:
    """A run that learnt no objects."""
    run_folder.write_trajectories(tmp_path, record)
    write_camera(tmp_path / "camera.json", CAMERA)
    run_folder.write_map(tmp_path, lambda: [_gaussians(4, None)])
    run_folder.write_objects(tmp_path, [])
    return tmp_path


def test_a_run_without_objects_opens(folder):
    run = ggwarp.load_run(folder)
    assert isinstance(run, ggwarp.SavedRun)
    assert run.objects == () and run.classifier is None and len(run.gaussians) == 4 and len(run.poses) == 3


def test_a_run_without_a_list_of_objects_has_those_of_its_map(folder):
    run_folder.write_map(folder, lambda: [_gaussians(4, [0, 7, 7, 2])])
    (folder / "objects.json").unlink()
    run = load_run(folder)
    assert [(o.id, o.count) for o in run.objects] == [(2, 1), (7, 2)]


def test_what_was_opened_is_saved_and_opened_again(folder):
    save_run(load_run(folder), folder / "copy")
    run = load_run(folder / "copy")
    assert run.camera == CAMERA and len(run.gaussians) == 4 and run.objects == ()


@pytest.mark.parametrize("name", ["map.ply", "camera.json", "trajectory.txt"])
def test_what_is_missing_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(RunError, match=name):
        load_run(folder)
