# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ggwarp.editing.edits import extract
from ggwarp.editing.map_view import MapView, best_views, crop_to
from ggwarp.results.saved_run import load_run


def test_coverage_shares_a_pixel_out(run_folder, device):
    run = load_run(run_folder)
    view = MapView(run.gaussians, run.camera, device=device)
    before = view.render(run.poses[2])
    shares = view.coverage(run.poses[2], *(run.gaussians.object_ids == i for i in (1, 5, 8)))
    np.testing.assert_allclose(shares.sum(0), before.opacity, atol=1e-4)
    assert shares[1, 31, 31] > 0.95 and shares[0, 20, 85] > 0.9  # the red cube, and bare wall
    after = view.render(run.poses[2])
    np.testing.assert_array_equal(before.rgb, after.rgb)  # it leaves the picture as it was
    assert before.rgb[31, 31, 0] > 0.8 and before.rgb[31, 31, 1] < 0.2


def test_another_camera_sees_the_same_map(run_folder, device):
    run = load_run(run_folder)
    view, small = MapView(run.gaussians, run.camera, device=device), run.camera.resized(40, 30)
    found = view.through(small).render(run.poses[2])
    wanted = MapView(run.gaussians, small, device=device).render(run.poses[2])
    np.testing.assert_array_equal(found.rgb, wanted.rgb)
    assert view.render(run.poses[2]).rgb.shape == (run.camera.height, run.camera.width, 3)


def test_weights_share_the_pixels_out(run_folder, device):
    run = load_run(run_folder)
    view = MapView(run.gaussians, run.camera, device=device)
    left = np.zeros((run.camera.height, run.camera.width), bool)
    left[:, :40] = True
    weights = view.weights(run.poses[2], left, ~left)
    for identifier in (1, 5, 8):
        own = run.gaussians.object_ids == identifier
        share = view.coverage(run.poses[2], own)[0]
        np.testing.assert_allclose(weights[0, own].sum(), share[left].sum(), rtol=1e-3, atol=1e-2)
        np.testing.assert_allclose(weights[1, own].sum(), share[~left].sum(), rtol=1e-3, atol=1e-2)
    assert weights.shape == (2, len(run.gaussians)) and weights.min() >= 0.0


def test_what_is_hidden_covers_nothing(run_folder):
    run = load_run(run_folder)
    behind = run.gaussians.object_ids == 1
    behind &= np.abs(run.gaussians.means[:, :2] + [0.45, 0.0]).max(1) < 0.1
    assert behind.any()
    share = MapView(run.gaussians, run.camera).coverage(run.poses[2], behind)[0]
    assert share.max() < 0.1


def test_best_views_see_the_object(run_folder):
    run = load_run(run_folder)
    view = MapView(run.gaussians, run.camera)
    chosen = run.gaussians.object_ids == 5
    found = best_views(view, run.poses, chosen, count=3)
    assert len(found) == 3 and 4 not in found  # the last looks away
    areas = [view.coverage(run.poses[i], chosen)[0].sum() for i in found]
    assert areas == sorted(areas, reverse=True)
    away = run.poses[4:]
    assert best_views(view, away, chosen, count=3) == []


def test_crop():
    mask = np.zeros((20, 30), bool)
    mask[4:7, 1:3] = True
    assert crop_to(mask, margin=2) == (slice(2, 9), slice(0, 5))
    assert np.zeros((20, 30))[crop_to(~mask & mask, margin=2)].shape == (20, 30)


@pytest.mark.parametrize("keep", [0, 1])
def test_a_map_of_next_to_nothing(run_folder, keep):
    run = load_run(run_folder)
    few = extract(run.gaussians, np.arange(len(run.gaussians)) < keep)
    assert MapView(few, run.camera).render(np.eye(4)).opacity.max() < 1.0
