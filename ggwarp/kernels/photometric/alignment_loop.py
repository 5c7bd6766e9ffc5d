# SPDX-License-Identifier: Apache-2.0
"""The loop of direct alignment on the device: linearise, solve, move the pose, size by size.

The host reads nothing on the way, so that all sizes can be one recorded graph. The unknowns are tau and each
reference's (a, b). A reference's exposure meets the others' only through tau: it is eliminated from its own
system first, so that a step is one of six unknowns, however many references there are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from ggwarp.kernels.math import mat66d, solve_positive
from ggwarp.kernels.photometric.alignment import (
    AlignmentArrays,
    AlignmentProblem,
    AlignmentSize,
    linearisation,
)
from ggwarp.kernels.rigid import se3_exp, se3_log
from ggwarp.runtime.launch import Work, in_turn, prepared

wp.set_module_options({"enable_backward": False})

ACTIVE, LEFT, CONVERGED, STEPS, STATES = 0, 1, 2, 3, 4
"""Places in the state: whether a size goes on, and for how many linearisations at most; whether the last step
was small; steps in all."""

_STEADY = wp.constant(wp.float64(1.0 + 1e-5))
"""A hundred-thousandth of the diagonal steadies directions that nothing fixes."""

mat62d = wp.types.matrix((6, 2), wp.float64)
mat22d = wp.types.matrix((2, 2), wp.float64)


@dataclass(frozen=True)
class StepRules:
    """When a size is done.

    Attributes:
        share: pixels that count for each that is compared.
        exposure_precision: inverse variance of a reference's a and b about 0.
        iterations: steps at most.
        settled: a step is small where it is less, in standard deviations of what the size's pixels say.
        deviation_share: pixels of the finest size that stand for one of this size, by which that is judged.
        least_pixels: with fewer to compare this size decides nothing; 0: it decides always.
    """

    share: float
    exposure_precision: float
    iterations: int
    settled: float
    deviation_share: float
    least_pixels: float = 0.0


@wp.func
def _pose_block(systems: wp.array2d[wp.float64], r: int) -> mat66d:
    H = mat66d()
    k = int(0)
    for i in range(6):
        for j in range(i, 6):
            H[i, j] = systems[r, k]
            H[j, i] = systems[r, k]
            k += 1
        k += 2
    return H


@wp.func
def _mixed_block(systems: wp.array2d[wp.float64], r: int) -> mat62d:
    B = mat62d()
    k = int(6)
    for i in range(6):
        B[i, 0] = systems[r, k]
        B[i, 1] = systems[r, k + 1]
        k += 7 - i
    return B


@wp.func
def _exposure_block(
    systems: wp.array2d[wp.float64], r: int, share: wp.float64, precision: wp.float64
) -> mat22d:
    mixed = share * systems[r, 34]
    return mat22d(share * systems[r, 33] + precision, mixed, mixed, share * systems[r, 35] + precision)


@wp.func
def _exposure_gradient(
    systems: wp.array2d[wp.float64], r: int, share: wp.float64, precision: wp.float64, exposure: wp.vec2d
) -> wp.vec2d:
    return share * wp.vec2d(systems[r, 42], systems[r, 43]) + precision * exposure


@wp.func
def _steadied(E: mat22d) -> mat22d:
    return mat22d(_STEADY * E[0, 0], E[0, 1], E[1, 0], _STEADY * E[1, 1])


@wp.kernel
def _begin_kernel(iterations: int, state: wp.array[int]):
    state[ACTIVE] = wp.min(iterations, 1)
    state[LEFT] = iterations


@wp.kernel
def _update_kernel(
    references: int,
    share: wp.float64,
    precision: wp.float64,
    small: wp.float64,
    least_pixels: wp.float64,
    problems: wp.array[AlignmentProblem],
    systems: wp.array2d[wp.float64],
    T_cw: wp.array[wp.mat44d],
    exposures: wp.array[wp.vec2d],
    state: wp.array[int],
):
    fit = problems[0].fit_exposure != 0
    information = problems[0].information
    H = information
    g = information * se3_log(T_cw[0] * problems[0].known)
    pixels = wp.float64(0.0)
    for r in range(references):
        H += share * _pose_block(systems, r)
        for k in range(6):
            g[k] += share * systems[r, 36 + k]
        pixels += systems[r, 45]
    state[LEFT] = state[LEFT] - 1
    state[ACTIVE] = 0
    if pixels < least_pixels:
        return
    S = H
    for k in range(6):
        S[k, k] *= _STEADY
    right = -g
    if fit:
        for r in range(references):
            B = share * _mixed_block(systems, r)
            inverse = wp.inverse(_steadied(_exposure_block(systems, r, share, precision)))
            by_exposure = B * inverse
            S -= by_exposure * wp.transpose(B)
            right += by_exposure * _exposure_gradient(systems, r, share, precision, exposures[r])
    tau = solve_positive(S, right)
    size2 = wp.dot(tau, H * tau)
    if fit:
        for r in range(references):
            B = share * _mixed_block(systems, r)
            E = _exposure_block(systems, r, share, precision)
            across = wp.transpose(B) * tau
            gradient = _exposure_gradient(systems, r, share, precision, exposures[r])
            change = wp.inverse(_steadied(E)) * (-(gradient + across))
            if not wp.isfinite(change[0] + change[1]):
                change = wp.vec2d()
            size2 += wp.float64(2.0) * wp.dot(across, change) + wp.dot(change, E * change)
            exposures[r] = exposures[r] + change
    T_cw[0] = se3_exp(tau) * T_cw[0]
    state[STEPS] = state[STEPS] + 1
    state[CONVERGED] = wp.where(size2 < small, 1, 0)
    state[ACTIVE] = wp.where(state[LEFT] > 0 and not (size2 < small), 1, 0)


def pose_update(arrays: AlignmentArrays, rules: StepRules, *, references: int, device: Any) -> Work:
    """Return what takes a Gauss-Newton step of the pose and the exposures by ``systems``.

    A matrix that fixes no pose leaves it; too few pixels leave all.
    """
    a, r = arrays, rules
    inputs = [
        references, r.share, r.exposure_precision, r.deviation_share * r.settled**2, r.least_pixels,
        a.problem, a.systems,
    ]  # fmt: skip
    outputs = [a.T_cw, a.exposures, a.state]
    return prepared(_update_kernel, 1, inputs=inputs, outputs=outputs, device=device)


def run_size(
    arrays: AlignmentArrays,
    rules: StepRules,
    *,
    level: int,
    size: AlignmentSize,
    references: int,
    device: Any,
) -> None:
    """Linearise and step at one size until that is done.

    In a recording this is a loop of the graph's, else one of the host's, which reads the state.

    Args:
        level: the size's place in ``arrays.views``.
    """
    step = in_turn(
        linearisation(arrays, level=level, size=size, references=references, device=device),
        pose_update(arrays, rules, references=references, device=device),
    )
    wp.launch(_begin_kernel, dim=1, inputs=[rules.iterations], outputs=[arrays.state], device=device)
    wp.capture_while(arrays.state[ACTIVE : ACTIVE + 1], step)
