# SPDX-License-Identifier: Apache-2.0
"""One registration after another in arrays that are kept, direct and recorded."""

import numpy as np
import pytest
import warp as wp

from benchmarking.inputs.walls import walls_cloud, walls_target
from ggwarp.geometry import se3
from ggwarp.solvers.registration import Cloud, Registrar, RegistrationStage, register
from ggwarp.solvers.registration_stages import coarse_to_fine_stages, register_coarse_to_fine

STAGES = [RegistrationStage(0.3, 6, 1e-3, 30.0, thinning=3), RegistrationStage(0.08, 15, 1e-6, 3.0)]


@pytest.mark.parametrize("recorded", [False, True])
def test_any_clouds_and_targets_in_a_row(rng, device, recorded):
    if recorded and wp.get_device(device).is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("the driver has no loops in graphs")
    registrar = Registrar(device=device, recorded=recorded)
    targets = [walls_target(rng, 4000, device), walls_target(rng, 3000, device)]
    for i, n in enumerate((1000, 900, 1200, 4000, 700, 3999)):  # 4000: outgrows the arrays
        T = se3.se3_exp(rng.normal(size=6) * 0.02)
        seen = walls_cloud(rng, n, T, device)
        found = registrar.register(seen, targets[i % 2], np.eye(4), STAGES)
        fresh = register(seen, targets[i % 2], np.eye(4), STAGES, device=device)
        assert np.linalg.norm(se3.se3_log(se3.inverse(T) @ found.T_wc)) < 2e-3
        assert found.converged and found.matched > 0.8 * n
        assert (found.iterations, found.matched) == (fresh.iterations, fresh.matched)
        # A recording sums rows of no points, too.
        np.testing.assert_allclose(found.T_wc, fresh.T_wc, atol=1e-10)
        np.testing.assert_allclose(found.information, fresh.information, rtol=1e-8, atol=1e-3)
        assert found.cost == pytest.approx(fresh.cost, rel=1e-8)


@pytest.mark.parametrize("recorded", [False, True])
def test_nothing_to_register(rng, device, recorded, monkeypatch):
    recordings = []
    begin = wp.capture_begin
    monkeypatch.setattr(wp, "capture_begin", lambda *a, **k: (recordings.append(0), begin(*a, **k))[1])
    registrar = Registrar(device=device, recorded=recorded)
    empty = walls_cloud(rng, 0, np.eye(4), device)
    T_start = se3.se3_exp([0.1, 0.2, 0.3, 0.0, 0.1, 0.0])
    for _ in range(3):
        for points, stages in ((empty, STAGES), (walls_cloud(rng, 50, np.eye(4), device), [])):
            found = registrar.register(points, walls_target(rng, 100, device), T_start, stages)
            np.testing.assert_allclose(found.T_wc, T_start, atol=1e-12)
            assert found.matched == 0 and not found.information.any()
    assert len(recordings) == recorded, "what has no stages is nothing to record"


def test_residuals_are_as_large_as_half_the_points_say(rng, device):
    target, registrar = walls_target(rng, 4000, device), Registrar(device=device)
    seen = walls_cloud(rng, 2000, np.eye(4), device)
    still = registrar.residual_scale(seen, target, np.eye(4), radius=0.08)
    found = registrar.register(seen, target, np.eye(4), STAGES, residual_radius=0.08)
    assert found.residual_scale == registrar.residual_scale(seen, target, found.T_wc, radius=0.08)
    short = registrar.register(seen, target, np.eye(4), STAGES, across=False)
    np.testing.assert_array_equal(short.T_wc, found.T_wc)
    assert found.across.any() and not short.across.any()
    off = registrar.residual_scale(seen, target, se3.se3_exp([0.02, 0.02, 0.02, 0, 0, 0]), radius=0.08)
    assert still < 0.3 * off
    # Two of five points move, and nothing is seen of it.
    points = seen.points.numpy()
    points[::5] += 0.03
    points[1::5] -= 0.03
    moving = Cloud(wp.array(points, dtype=wp.vec3, device=device), seen.covariances)
    assert registrar.residual_scale(moving, target, np.eye(4), radius=0.08) < 3.0 * still
    nowhere = se3.se3_exp([50.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert registrar.residual_scale(seen, target, nowhere, radius=0.08) == np.inf


def test_what_moves_does_not_take_the_pose_along(rng, device):
    target, registrar = walls_target(rng, 4000, device), Registrar(device=device)
    seen = walls_cloud(rng, 2000, np.eye(4), device)
    points = seen.points.numpy()
    points[: len(points) // 3] += 0.02
    moving = Cloud(wp.array(points, dtype=wp.vec3, device=device), seen.covariances)
    found = register_coarse_to_fine(registrar, moving, target, np.eye(4), 0.03)
    errors = [np.linalg.norm(se3.se3_log(found.T_wc))]
    believed = registrar.register(moving, target, np.eye(4), coarse_to_fine_stages(0.03))
    errors.append(np.linalg.norm(se3.se3_log(believed.T_wc)))
    assert errors[0] < 2e-3 and errors[0] <= errors[1]


def test_kernels_are_as_wide_as_what_is_seen_and_no_wider_than_noise():
    usual, wide, narrow, none = (
        [stage.robust_scale for stage in coarse_to_fine_stages(0.01, scale)]
        for scale in (np.inf, 20.0, 0.5, 0.0)
    )
    assert usual == wide == pytest.approx([30.0, 10.0, 3.0])
    assert narrow == [1.5] * 3
    assert all(0.0 < scale < 0.1 for scale in none)
