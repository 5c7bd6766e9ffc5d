# SPDX-License-Identifier: Apache-2.0
"""A step of direct alignment on the device, against NumPy's solution of all unknowns at once."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.photometric import alignment_loop
from ggwarp.kernels.photometric.alignment import SUMS, AlignmentSize
from ggwarp.solvers.alignment_arrays import AlignmentLoopArrays, Comparison, Reference, view_rows
from ggwarp.solvers.pose_equations import Prior

SIZE = AlignmentSize(intrinsics_of(Camera(4, 4, 1.0, 1.0, 0.0, 0.0)), 4, 4)
COMPARISON = Comparison(0.05, 0.0, 3.0, 0.05, 0.0)
PRECISION, SHARE = 11.0, 0.12
START = se3.se3_exp([0.2, -0.1, 0.4, 0.3, -0.2, 0.1])


def rules(**changed: Any) -> alignment_loop.StepRules:
    values = dict(share=SHARE, exposure_precision=PRECISION, iterations=5, settled=0.1, deviation_share=4.0)
    return alignment_loop.StepRules(**{**values, **changed})


def drawn(rng: np.random.Generator, references: int, rank: int = 40) -> np.ndarray:
    """Return systems [n, SUMS] of ``rank`` random residuals each."""
    J, r = rng.normal(size=(references, rank, 8)), 0.1 * rng.normal(size=(references, rank))
    out = np.zeros((references, SUMS))
    rows, columns = np.triu_indices(8)
    out[:, :36] = np.einsum("nki,nkj->nij", J, J)[:, rows, columns]
    out[:, 36:44] = np.einsum("nki,nk->ni", J, r)
    out[:, 44], out[:, 45] = (r**2).sum(axis=1), rank
    return out


def stepped(
    systems: np.ndarray,
    exposures: list[tuple[float, float]],
    device: str,
    prior: Prior | None = None,
    *,
    fit_exposure: bool = True,
    given: alignment_loop.StepRules | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pose, the exposures and the state after a step from ``START``."""
    count = len(systems)
    arrays = AlignmentLoopArrays(count, [SIZE], device)
    levels = [wp.zeros((4, 4), dtype=wp.vec4, device=device)]
    reference = Reference(levels, np.eye(4), view_rows(levels, levels))
    arrays.load([reference] * count, START, exposures, COMPARISON, prior, fit_exposure=fit_exposure)
    arrays.loop.systems.assign(systems)
    arrays.loop.state.assign(np.array([1, 5, 0, 2], np.int32))
    alignment_loop.pose_update(arrays.loop, given or rules(), references=count, device=device)()
    T_cw, moved, _, state = arrays.read(count)
    return T_cw, np.array(moved), state


def expected(
    systems: np.ndarray, exposures: list[tuple[float, float]], prior: Prior | None, fit_exposure: bool
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the pose, the exposures, and the square of the step in standard deviations."""
    size = 6 + 2 * len(systems)
    H, g = np.zeros((size, size)), np.zeros(size)
    for i, system in enumerate(systems):
        own = [*range(6), 6 + 2 * i, 7 + 2 * i]
        upper = np.zeros((8, 8))
        upper[np.triu_indices(8)] = system[:36]
        H[np.ix_(own, own)] += SHARE * (upper + np.triu(upper, 1).T)
        g[own] += SHARE * system[36:44]
        H[own[6:], own[6:]] += PRECISION
        g[own[6:]] += PRECISION * np.array(exposures[i])
    if prior is not None:
        H[:6, :6] += prior.information
        g[:6] += prior.information @ se3.se3_log(START @ se3.inverse(prior.T_cw))
    used = size if fit_exposure else 6
    steadied = H + 1e-5 * np.diag(np.diag(H))
    step = np.zeros(size)
    step[:used] = np.linalg.solve(steadied[:used, :used], -g[:used])
    T_cw = se3.se3_exp(step[:6]) @ START
    return T_cw, np.array(exposures) + step[6:].reshape(-1, 2), float(step @ H @ step)


@pytest.mark.parametrize("fit_exposure", [True, False])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("references", [1, 2, 5])
def test_a_step_solves_for_all_unknowns(device, rng, references, known, fit_exposure) -> None:
    systems = drawn(rng, references)
    exposures = [(float(a), float(b)) for a, b in rng.normal(0.0, 0.1, (references, 2))]
    root = rng.normal(size=(6, 6))
    near = se3.se3_exp(rng.normal(0.0, 0.05, 6)) @ START
    prior = Prior(near, 3.0 * root @ root.T) if known else None
    T_cw, moved, size2 = expected(systems, exposures, prior, fit_exposure)
    found = stepped(systems, exposures, device, prior, fit_exposure=fit_exposure)
    np.testing.assert_allclose(found[0], T_cw, atol=1e-12)
    np.testing.assert_allclose(found[1], moved, atol=1e-12)
    for settled, small in ((1.001, 1), (0.999, 0)):
        limit = rules(settled=settled * (size2 / 4.0) ** 0.5)
        state = stepped(systems, exposures, device, prior, fit_exposure=fit_exposure, given=limit)[2]
        assert state.tolist() == [1 - small, 4, small, 3]


def test_few_pixels_decide_nothing(device, rng) -> None:
    T_cw, moved, state = stepped(drawn(rng, 2), [(0.1, 0.2)] * 2, device, given=rules(least_pixels=80.5))
    np.testing.assert_array_equal(T_cw, START)
    assert (moved == [(0.1, 0.2)] * 2).all() and state.tolist() == [0, 4, 0, 2]
    assert stepped(drawn(rng, 2), [(0.1, 0.2)] * 2, device, given=rules(least_pixels=80))[2][3] == 3


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_fixes_no_pose_leaves_it(device, value) -> None:
    systems = np.full((2, SUMS), value)
    systems[:, 45] = 100.0
    T_cw, moved, _ = stepped(systems, [(0.1, 0.2)] * 2, device)
    np.testing.assert_allclose(T_cw, START, atol=1e-15)
    assert np.isfinite(moved).all()


def test_the_last_allowed_step_ends_a_size(device, rng) -> None:
    arrays = AlignmentLoopArrays(1, [SIZE], device)
    levels = [wp.zeros((4, 4), dtype=wp.vec4, device=device)]
    arrays.load([Reference(levels, np.eye(4), view_rows(levels, levels))], START, [(0.0, 0.0)], COMPARISON)
    for iterations in (0, 1, 3):
        limit = rules(iterations=iterations, settled=0.0)
        alignment_loop.run_size(arrays.loop, limit, level=0, size=SIZE, references=1, device=device)
    assert arrays.read(1)[3].tolist() == [0, 0, 0, 4]
