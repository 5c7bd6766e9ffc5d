# SPDX-License-Identifier: Apache-2.0
"""Trackable points of a finished run: its own, or made of its Gaussians."""

import shutil

import numpy as np
import pytest

from ggwarp import run
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import Gaussians
from ggwarp.pipeline.surface_points import saved_points, surface_points
from ggwarp.pipeline.tracking.preprocess import ObservationConfig
from ggwarp.results.checkpoints import checkpoint_files
from ggwarp.results.saved_run import load_run

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
CONFIG = ObservationConfig()


def wall(rng, noise: float) -> Gaussians:
    """A wall at z = 2.02 m, and some that hide 0.5 m behind it."""
    n = 6000
    means = np.stack([*rng.uniform(-0.8, 0.8, (2, n)), 2.02 + noise * rng.normal(size=n)], axis=1)
    means[:500, 2] += 0.5
    logits = np.full(n, 3.0, np.float32)
    logits[500:1000] = -3.0
    means[500:1000, 2] -= 0.05  # a haze before it
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    return Gaussians(
        means.astype(np.float32),
        quats,
        np.full((n, 3), -4.0, np.float32),
        logits,
        np.zeros((n, 3), np.float32),
    )


def test_points_lie_on_the_surface_and_face_the_camera(rng, device) -> None:
    views = [(np.full((60, 80), 2.02, np.float32), np.eye(4))]
    points = surface_points(wall(rng, 0.004), views, CAMERA, CONFIG, spacing=0.05, device=device)
    assert 800 < len(points.points) < 1200 and np.isinf(points.distances2).all()
    assert (
        np.abs(points.points[:, 2] - 2.02).max() < 0.012 and np.abs(points.points[:, 2] - 2.02).mean() < 0.003
    )
    normals = se3.matrices_from_quats(points.quats)[:, :, 2]
    assert np.median(np.abs(normals[:, 2])) > 0.99
    assert (points.spreads[:, 2] < points.spreads[:, 0]).all(), "free along the wall"
    np.testing.assert_allclose(points.noise, CONFIG.depth_noise(np.float32(2.02)), rtol=0.05)


def test_what_no_view_shows_gives_none(rng, device) -> None:
    behind = se3.se3_exp([0.0, 0.0, 5.0, 0.0, 0.0, 0.0])
    for views in ([], [(np.full((60, 80), 2.02, np.float32), behind)]):
        points = surface_points(wall(rng, 0.0), views, CAMERA, CONFIG, spacing=0.05, device=device)
        assert len(points.points) == 0


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "o"
    options = "--seq office --preset fast --device cpu --scale 0.1 --frames 0:6:2 --save-renders 0 -q".split()
    assert run.main([*options, "--checkpoint-every", "1", "--out", str(out)]) == 0
    return out


def test_a_checkpoint_of_a_run_s_end_has_its_own(finished, tmp_path) -> None:
    points = saved_points(load_run(finished))
    assert points is not None and len(points.points) > 500
    nearest = load_run(finished).gaussians.means
    assert points.points.min() > nearest.min() - 0.1 and points.points.max() < nearest.max() + 0.1
    other = shutil.copytree(finished, tmp_path / "o")
    checkpoint_files(other)[0].unlink()
    assert saved_points(load_run(other)) is None, "one of the way is not of the end"
    for path in checkpoint_files(other):
        path.write_bytes(b"nothing")
    assert saved_points(load_run(other)) is None
