# SPDX-License-Identifier: Apache-2.0
"""How far an estimated trajectory is from the true one.

The absolute trajectory error (ATE) is the distance between camera centres after the best
rigid alignment (Umeyama, 1991). Its root mean square and its mean are different numbers and
are named here as what they are. The relative pose error (RPE) compares motions over a fixed
number of frames and needs no alignment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggwarp.types import Float64


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of a trajectory, metres.

    Attributes:
        rmse, mean, median, maximum: of the per-frame errors.
        per_frame: [n] the errors.
    """

    rmse: float
    mean: float
    median: float
    maximum: float
    per_frame: Float64

    @staticmethod
    def of(errors: Float64) -> TrajectoryError:
        """Summarise per-frame ``errors`` [n], n >= 1."""
        return TrajectoryError(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            maximum=float(np.max(errors)),
            per_frame=errors,
        )


def align(source: Float64, target: Float64, *, with_scale: bool = False) -> tuple[float, Float64, Float64]:
    """Find the similarity that brings ``source`` closest to ``target`` (Umeyama, 1991).

    Where the points leave the rotation undetermined (one point, a line), the one nearest to what the
    decomposition gives is returned: the residual is the same for all of them.

    Args:
        source, target: [n, 3] matching points, metres, n >= 1.
        with_scale: also fit the scale, as monocular trajectories need; else 1.

    Returns:
        scale s, rotation R [3, 3] and translation t [3] minimising |target - (s R source + t)|^2.

    Raises:
        ValueError: when the shapes differ or there are no points.
    """
    if source.shape != target.shape or source.ndim != 2 or len(source) == 0:
        raise ValueError(f"cannot align points of shapes {source.shape} and {target.shape}")
    source_mean, target_mean = source.mean(0), target.mean(0)
    centred = source - source_mean
    U, singular, Vt = np.linalg.svd((target - target_mean).T @ centred / len(source))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * signs) @ Vt
    variance = np.mean(np.sum(centred**2, axis=1))
    scale = float(singular @ signs / variance) if with_scale and variance > 0.0 else 1.0
    return scale, R, target_mean - scale * R @ source_mean


def to_scale(estimated: Float64, true: Float64) -> tuple[Float64, float]:
    """Return [n, 4, 4] ``estimated`` at the scale at which it fits ``true`` best, and that scale.

    A monocular trajectory has no scale of its own: aligned rigidly after this it is aligned by Sim(3).
    """
    scale, _, _ = align(estimated[:, :3, 3], true[:, :3, 3], with_scale=True)
    scaled = estimated.copy()
    scaled[:, :3, 3] *= scale
    return scaled, scale


def absolute_error(estimated: Float64, true: Float64, *, with_scale: bool = False) -> TrajectoryError:
    """Return the absolute trajectory error after alignment.

    Args:
        estimated, true: [n, 4, 4] camera-to-world poses of the same frames, metres, n >= 1.
        with_scale: align by Sim(3) instead of SE(3).
    """
    source, target = estimated[:, :3, 3], true[:, :3, 3]
    scale, R, t = align(source, target, with_scale=with_scale)
    return TrajectoryError.of(np.linalg.norm(target - (scale * source @ R.T + t), axis=1))


def relative_error(estimated: Float64, true: Float64, *, step: int = 1) -> TrajectoryError | None:
    """Return the translational relative pose error over ``step`` frames.

    Args:
        estimated, true: [n, 4, 4] camera-to-world poses of the same frames, metres.
        step: frames between the two poses of a pair, at least 1.

    Returns:
        The error of each pair's motion, or None when there is no pair.
    """
    if step < 1:
        raise ValueError(f"step: {step}, but at least 1 is needed")
    if len(true) <= step:
        return None
    moved_estimated = np.linalg.inv(estimated[:-step]) @ estimated[step:]
    moved_true = np.linalg.inv(true[:-step]) @ true[step:]
    difference = np.linalg.inv(moved_true) @ moved_estimated
    return TrajectoryError.of(np.linalg.norm(difference[:, :3, 3], axis=1))
