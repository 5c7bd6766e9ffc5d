# SPDX-License-Identifier: Apache-2.0
"""Generalised ICP: system against the oracle and finite differences, update, determinism."""

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.kernels.registration import gicp, gicp_loop
from ggwarp.kernels.registration.gicp import SUMS, block_count, linearisation, match_points
from ggwarp.kernels.registration.gicp_loop import CONVERGED, ITERATIONS, LoopArrays, pose_update, run_stage
from ggwarp.kernels.registration.gicp_pairs import fix_across, pair_residuals
from ggwarp.kernels.registration.hash_grid import allocate_hash_grid, build_hash_grid
from ggwarp.ops.reference.registration import gicp_cost, gicp_system


def make_covariances(rng, n):
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    A = axes * rng.uniform([0.5, 0.5, 0.02], [2.0, 1.5, 0.1], (n, 3))[:, None, :]
    return A @ A.transpose(0, 2, 1)


class Case:
    """Matched points of a frame and a map, a pose near the true one."""

    def __init__(self, rng, n, device="cpu", noise=0.002, step=0.01, kept=True):
        self.T_true = se3.se3_exp(np.concatenate([rng.normal(size=3) * 2.0, rng.normal(size=3)]))
        self.points = rng.uniform([-1.0, -1.0, 1.0], [1.0, 1.0, 3.0], (n, 3)).astype(np.float32)
        self.covariances = make_covariances(rng, n)
        world = self.points @ self.T_true[:3, :3].T + self.T_true[:3, 3]
        self.targets = (world + noise * rng.normal(size=(n, 3))).astype(np.float32)
        self.target_covariances = make_covariances(rng, n)
        self.T_start = self.T_true @ se3.se3_exp(step * rng.normal(size=6))
        self.device = device
        self.grid = allocate_hash_grid(n, device=device)
        build_hash_grid(self.grid, self._vec3(self.targets), cell_size=0.1, device=device)
        self.order = self.grid.indices.numpy()[:n]
        self.grid_covariances = self._mat33(self.target_covariances[self.order])
        self.device_points = self._vec3(self.points)
        self.device_covariances = self._mat33(self.covariances)
        self.matches = wp.zeros(n, dtype=int, device=device)
        self.distances2 = wp.zeros(n, dtype=float, device=device)
        self.pose = wp.array([self.T_start], dtype=wp.mat44d, device=device)
        self.system = wp.zeros(SUMS, dtype=wp.float64, device=device)
        self.progress = wp.zeros(gicp_loop.PROGRESS, dtype=wp.float64, device=device)
        problem = gicp.Problem()
        problem.points, problem.covariances = self.device_points, self.device_covariances
        problem.grid, problem.grid_covariances = self.grid, self.grid_covariances
        problem.matches = self.matches
        self.searched = wp.zeros(n if kept else 0, dtype=wp.vec4, device=device)
        problem.searched = self.searched
        self.arrays = LoopArrays(
            problem=wp.array([problem], dtype=gicp.Problem, device=device),
            stages=wp.zeros(2, dtype=gicp.StageSettings, device=device),
            pose=self.pose,
            system=self.system,
            progress=self.progress,
            state=wp.zeros(gicp_loop.STATES, dtype=int, device=device),
            sums=wp.zeros((max(1, block_count(n, device)), SUMS), dtype=wp.float64, device=device),
            folded=wp.zeros((gicp.FOLDED, SUMS), dtype=wp.float64, device=device),
        )

    def _vec3(self, x):
        return wp.array(np.asarray(x, np.float32).reshape(-1, 3), dtype=wp.vec3, device=self.device)

    def _mat33(self, x):
        return wp.array(np.asarray(x, np.float32).reshape(-1, 3, 3), dtype=wp.mat33, device=self.device)

    def match(self, radius):
        """``found`` is then where each match is in the grid's order, -1 for none."""
        count = len(self.points)
        match_points(
            self.arrays.problem,
            self.pose,
            count=count,
            radius=radius,
            distances2=self.distances2,
            device=self.device,
        )
        near = np.isfinite(self.distances2.numpy())
        self.found = np.where(near, self.matches.numpy(), -1)

    def set_stage(self, radius=0.2, robust_scale=1e6, thinning=1, iterations=10, tolerance=0.0):
        stage = gicp.StageSettings()
        stage.radius, stage.robust_scale, stage.thinning = radius, robust_scale, thinning
        stage.iterations, stage.tolerance = iterations, tolerance
        self.arrays.stages.assign([gicp.StageSettings(), stage])

    def linearise(self, radius=0.2, robust_scale=1e6, thinning=1):
        self.set_stage(radius, robust_scale, thinning)
        linearisation(
            self.arrays.problem,
            self.arrays.stages,
            stage=1,
            count=-(-len(self.points) // thinning),
            pose=self.pose,
            sums=self.arrays.sums,
            folded=self.arrays.folded,
            system=self.system,
            device=self.device,
        )()
        return self.system.numpy()

    def across(self, radius=0.2, robust_scale=1e6):
        self.set_stage(radius, robust_scale)
        fix_across(
            self.arrays.problem,
            self.arrays.stages,
            stage=1,
            count=len(self.points),
            pose=self.pose,
            sums=self.arrays.sums,
            folded=self.arrays.folded,
            system=self.system,
            device=self.device,
        )
        return unpack(self.system.numpy())[0]

    def residuals2(self, radius=0.2):
        n = len(self.points)
        found = wp.zeros(n, dtype=float, device=self.device)
        pair_residuals(
            self.arrays.problem, self.pose, count=n, radius=radius, residuals2=found, device=self.device
        )
        return found.numpy()

    def update(self, damping=0.0):
        pose_update(self.arrays, stage=1, damping=damping, device=self.device)()
        return self.progress.numpy()[:2]

    def run(self):
        run_stage(self.arrays, stage=1, count=len(self.points), device=self.device)
        return self.pose.numpy()[0]

    def pairs(self):
        j = self.found
        m = j >= 0
        o = self.order[j[m]]
        return self.points[m], self.covariances[m], self.targets[o], self.target_covariances[o]


def unpack(system):
    H = np.zeros((6, 6))
    H[np.triu_indices(6)] = system[:21]
    return H + np.triu(H, 1).T, system[21:27]


@pytest.mark.parametrize("n", [1, 31, 33, 500])
@pytest.mark.parametrize("robust_scale", [1e6, 0.01])
def test_system_agrees_with_the_oracle(rng, device, n, robust_scale):
    problem = Case(rng, n, device)
    problem.match(0.2)
    system = problem.linearise(0.2, robust_scale)
    H, g = unpack(system)
    pairs = problem.pairs()
    expected_H, expected_g = gicp_system(problem.T_start, *pairs, robust_scale=robust_scale)
    assert np.linalg.norm(H - expected_H) <= 1e-5 * np.linalg.norm(expected_H)
    assert np.linalg.norm(g - expected_g) <= 1e-4 * np.linalg.norm(expected_g)
    cost = gicp_cost(problem.T_start, *pairs, robust_scale=robust_scale)
    np.testing.assert_allclose(system[27], cost, rtol=1e-3)
    assert system[28] == len(pairs[0])


@pytest.mark.parametrize("n", [1, 33, 500])
def test_residuals_agree_with_the_oracle(rng, device, n):
    problem = Case(rng, n, device)
    problem.points[0] = np.nan
    problem.device_points.assign(problem.points)
    problem.match(0.2)
    found, matched = problem.residuals2(0.2), problem.found >= 0
    assert np.array_equal(np.isfinite(found), matched) and not matched[0]
    pairs = [np.float64(side) for side in problem.pairs()]
    for value, *pair in zip(found[matched], *pairs, strict=True):
        cost = gicp_cost(problem.T_start, *(np.asarray(side)[None] for side in pair), robust_scale=np.inf)
        assert value == pytest.approx(cost, rel=2e-3, abs=1e-9)


@pytest.mark.parametrize("robust_scale", [np.inf, 0.05])
def test_gradient_against_finite_differences(rng, robust_scale):
    problem = Case(rng, 200)
    problem.match(0.2)
    pairs = problem.pairs()
    # Covariances as round as balls: M does not turn with the pose, so that g is the exact gradient.
    balls = np.tile(np.eye(3), (len(pairs[0]), 1, 1))
    pairs = (pairs[0], balls, pairs[2], balls)
    _, g = gicp_system(problem.T_start, *pairs, robust_scale=robust_scale)
    h = 1e-6
    numeric = np.array(
        [
            sum(
                sign
                * gicp_cost(problem.T_start @ se3.se3_exp(sign * h * axis), *pairs, robust_scale=robust_scale)
                for sign in (1.0, -1.0)
            )
            / (2.0 * h)
            for axis in np.eye(6)
        ]
    )
    gradient = -2.0 * g
    assert np.linalg.norm(gradient - numeric) <= 1e-4 * np.linalg.norm(numeric)
    assert gradient @ numeric >= 0.999 * np.linalg.norm(gradient) * np.linalg.norm(numeric)
    assert abs(np.sum(gradient - numeric)) <= 1e-3 * np.abs(numeric).sum()


def test_update_is_the_damped_step(rng, device):
    problem = Case(rng, 300, device)
    H, g = unpack(problem.linearise())
    step = problem.update(damping=0.1)
    xi = np.linalg.solve(H + 0.1 * np.diag(np.diag(H)), g)
    np.testing.assert_allclose(problem.pose.numpy()[0], problem.T_start @ se3.se3_exp(xi), atol=1e-12)
    np.testing.assert_allclose(step, [np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])], rtol=1e-9)


def test_registration_finds_the_pose_to_a_hundredth_of_a_millimetre(rng, device):
    problem = Case(rng, 2000, device, noise=0.0, step=0.01)
    problem.set_stage(0.1, 1.0, iterations=12)
    error = se3.se3_log(se3.inverse(problem.T_true) @ problem.run())
    assert np.linalg.norm(error[:3]) < 1e-6 and np.linalg.norm(error[3:]) < 1e-6
    assert problem.progress.numpy()[:2].max() < 1e-7


def test_a_stage_ends_when_the_step_is_small_or_its_iterations_are_done(rng, device):
    problem = Case(rng, 500, device)
    for iterations, tolerance, done, converged in ((3, 0.0, 3, 0), (20, 10.0, 1, 1), (0, 1.0, 0, 0)):
        problem.set_stage(iterations=iterations, tolerance=tolerance)
        problem.progress.zero_()
        problem.pose.assign([problem.T_start])
        problem.run()
        progress = problem.progress.numpy()
        assert (progress[ITERATIONS], progress[CONVERGED]) == (done, converged)
    problem.set_stage(iterations=50, tolerance=1e-7)
    problem.run()
    progress = problem.progress.numpy()
    assert 1 < progress[ITERATIONS] < 50 and progress[CONVERGED] == 1.0 and progress[:2].max() < 1e-7


def test_thinning_takes_every_so_manyth_point(rng, device):
    problem = Case(rng, 100, device)
    problem.match(0.2)
    kept = np.arange(0, 100, 7)
    j = problem.found[kept]
    o, m = problem.order[j[j >= 0]], kept[j >= 0]
    pairs = problem.points[m], problem.covariances[m], problem.targets[o], problem.target_covariances[o]
    system = problem.linearise(thinning=7)
    expected, _ = gicp_system(problem.T_start, *pairs, robust_scale=1e6)
    assert np.linalg.norm(unpack(system)[0] - expected) <= 1e-5 * np.linalg.norm(expected)
    assert system[28] == len(m) > 3


def test_many_points_are_folded_first(rng, device):
    n = 9 * gicp.FOLDED * gicp.points_per_block(device)
    problem = Case(rng, n, device)
    whole = problem.linearise().copy()
    parts = problem.arrays.sums.numpy()[: block_count(n, device)]
    np.testing.assert_allclose(whole, parts.sum(0), rtol=1e-10, atol=1e-6)
    assert problem.arrays.folded.numpy()[:, 28].all()


def test_large_turns(device):
    problem = Case(np.random.default_rng(0), 4, device)
    for turn in (1e-9, 1e-4, 1.0, 3.0):
        xi = np.array([0.3, -0.2, 0.1, turn, 0.0, 0.0])
        system = np.zeros(SUMS)
        H = np.eye(6)
        system[:21], system[21:27] = H[np.triu_indices(6)], xi
        problem.system.assign(system)
        problem.pose.assign([np.eye(4)])
        problem.update()
        np.testing.assert_allclose(problem.pose.numpy()[0], se3.se3_exp(xi), atol=1e-12)


@pytest.mark.parametrize("value", [0.0, np.nan, -1.0])
def test_a_system_that_cannot_be_solved_leaves_the_pose(rng, device, value):
    problem = Case(rng, 4, device)
    problem.system.fill_(value)
    np.testing.assert_array_equal(problem.update(), [0.0, 0.0])
    np.testing.assert_allclose(problem.pose.numpy()[0], problem.T_start, atol=1e-9)


def test_nothing_matches(rng, device):
    problem = Case(rng, 50, device)
    problem.pose.assign([se3.se3_exp([100.0, 0, 0, 0, 0, 0])])
    problem.match(0.1)
    assert (problem.found == -1).all() and np.isinf(problem.distances2.numpy()).all()
    np.testing.assert_array_equal(problem.linearise(), np.zeros(SUMS))


def test_the_same_bits_with_any_number_of_threads(rng, assert_same_on_any_threads):
    problem = Case(rng, 3001)
    assert_same_on_any_threads(lambda: [problem.linearise(0.1, 0.5).copy()])


@pytest.mark.parametrize("sizes", [[0.0], [1e-4], [3e-3, 1e-3, 1e-4], [0.05, 1e-3, 0.3], [5.0, 0.0]])
def test_kept_matches_are_those_of_a_search(rng, device, sizes):
    """To the bit, however far the pose moves, at any radius, of every n-th point or all."""
    kept, fresh = (Case(np.random.default_rng(3), 500, device=device, kept=kept) for kept in (True, False))
    assert len(kept.searched) and not len(fresh.searched)
    pose, searches = kept.T_true, 0
    for turn in range(12):
        pose = pose @ se3.se3_exp(sizes[turn % len(sizes)] * rng.normal(size=6))
        radius, thinning = rng.choice([0.02, 0.05, 0.2, 1.0]), int(rng.choice([1, 4]))
        before = kept.searched.numpy()
        for case in (kept, fresh):
            case.pose.assign(np.array([pose]))
        np.testing.assert_array_equal(
            kept.linearise(radius, 2.0, thinning), fresh.linearise(radius, 2.0, thinning)
        )
        np.testing.assert_array_equal(kept.residuals2(radius), fresh.residuals2(radius))
        for case in (kept, fresh):
            case.match(radius)
        np.testing.assert_array_equal(kept.distances2.numpy(), fresh.distances2.numpy())
        searches += int((kept.searched.numpy() != before).any(axis=1).sum())
    if max(sizes) <= 1e-4:
        assert searches < 3 * len(kept.points), "of twelve times as many"


def test_kept_matches_with_as_near_points_are_looked_for_again(device):
    """Of equally near points the first wins, wherever the search before was."""
    case = Case(np.random.default_rng(0), 2, device=device)
    targets = np.array([[0.5, 0.0, 1.0], [-0.5, 0.0, 1.0]], np.float32)
    build_hash_grid(case.grid, case._vec3(targets), cell_size=0.1, device=device)
    case.device_points.assign(np.array([[0.01, 0.0, 1.0], [-0.01, 0.0, 1.0]], np.float32))
    for x, expected in ((0.0, (0, 1)), (-0.01, (0, 1)), (0.01, (0, 0)), (-0.02, (1, 1)), (0.0, (0, 1))):
        T = np.eye(4)
        T[0, 3] = x
        case.pose.assign(T[None])
        case.match(1.0)
        assert case.grid.indices.numpy()[case.found].tolist() == list(expected), x
