# SPDX-License-Identifier: Apache-2.0
"""Depth from the motion of one camera: dense matches between two pictures, and what they say.

Matches are dense optical flow (DIS: Kroeger et al., ECCV 2016, as OpenCV has it) that agrees both ways.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.types import Float32, Float64

_DISAGREEMENT = 0.7
"""Pixels that the flow there and back may miss."""
_PIXEL_NOISE = 0.25
"""Of a match, pixels, standard deviation: the median on the built-in office."""
_EPIPOLAR = 1.0
"""Pixels that a match may lie off its epipolar line."""
_SAMPLES = 4000
_REFINED, _REFINEMENTS = 1000, 10
"""Matches that a motion is refined on, and how often its search begins anew from where it has come to."""


@dataclass(frozen=True)
class Matches:
    """Where each pixel of one picture lies in another.

    Attributes:
        at: [h, w, 2] (u, v) in the other picture.
        good: [h, w] bool, where there is a match.
    """

    at: NDArray[np.floating]
    good: NDArray[np.bool_]

    @property
    def share(self) -> float:
        """Share of the pixels that have a match."""
        return float(self.good.mean())


@dataclass(frozen=True)
class InverseDepth:
    """What pictures say of a picture's depth.

    Attributes:
        value: [h, w] 1 / metres, along the optical axis; 0 where ``weight`` is.
        weight: [h, w] inverse variance of ``value``, square metres; 0: nothing is known.
    """

    value: Float32
    weight: Float32

    def known(self, relative: float) -> NDArray[np.bool_]:
        """Return [h, w] where the depth is known to this share of it."""
        return (self.weight > 0.0) & (self.value * relative * np.sqrt(self.weight) > 1.0)

    def depth(self) -> Float32:
        """Return [h, w] metres; 0 where nothing is known."""
        return np.divide(1.0, self.value, out=np.zeros_like(self.value), where=self.value > 0.0)


class Matcher:
    """Matches grey pictures of one size."""

    def __init__(self) -> None:
        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._flow.setFinestScale(0)

    def match(self, here: NDArray[np.uint8], there: NDArray[np.uint8]) -> Matches:
        """Match every pixel of ``here`` [h, w] with ``there`` [h, w]."""
        h, w = here.shape
        forth, back = (np.asarray(self._flow.calc(*pair, None)) for pair in ((here, there), (there, here)))
        u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
        at = np.stack([u + forth[..., 0], v + forth[..., 1]], axis=-1)
        returned = forth + cv2.remap(back, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        inside = (at >= 0.0).all(axis=-1) & (at[..., 0] <= w - 1) & (at[..., 1] <= h - 1)
        return Matches(at, inside & (np.linalg.norm(returned, axis=-1) < _DISAGREEMENT))


def rays_of(camera: Camera) -> Float64:
    """Return [h, w, 3] the rays through the pixels' centres, 1 along the optical axis."""
    return camera.rays(np.arange(camera.width), np.arange(camera.height)[:, None])


def triangulate(matches: Matches, T_other: Float64, camera: Camera) -> InverseDepth:
    """Return the depth at which each pixel lies by its match (least squares along its epipolar line).

    Args:
        T_other: [4, 4] takes this camera's coordinates to the other's.
    """
    turned, t = rays_of(camera) @ T_other[:3, :3].T, T_other[:3, 3]
    x, y, _ = np.moveaxis(camera.rays(matches.at[..., 0], matches.at[..., 1]), -1, 0)
    # The point is at (turned + rho t), up to scale: x (turned_z + rho t_z) = turned_x + rho t_x, likewise y.
    a = np.stack([camera.fx * (t[0] - x * t[2]), camera.fy * (t[1] - y * t[2])], axis=-1)
    b = np.stack([camera.fx * (x * turned[..., 2] - turned[..., 0]),
                  camera.fy * (y * turned[..., 2] - turned[..., 1])], axis=-1)  # fmt: skip
    information = (a * a).sum(axis=-1)
    rho = (a * b).sum(axis=-1) / np.maximum(information, 1e-12)
    depth_there = turned[..., 2] + rho * t[2]  # over the depth here
    off = np.linalg.norm(a * rho[..., None] - b, axis=-1) / np.maximum(depth_there, 1e-6)
    good = matches.good & (rho > 1e-3) & (depth_there > 0.1) & (off < _EPIPOLAR) & (information > 1e-9)
    weight = np.where(good, information / (_PIXEL_NOISE * np.maximum(depth_there, 0.1)) ** 2, 0.0)
    return InverseDepth(np.where(good, rho, 0.0).astype(np.float32), weight.astype(np.float32))


def fuse(estimates: list[InverseDepth]) -> InverseDepth:
    """Return the mean by weight of several estimates; where they contradict each other nothing is known."""
    weight = np.sum([e.weight for e in estimates], axis=0)
    value = np.sum([e.weight * e.value for e in estimates], axis=0) / np.maximum(weight, 1e-12)
    error = np.sum([e.weight * (e.value - value) ** 2 for e in estimates], axis=0)
    seen = np.sum([e.weight > 0.0 for e in estimates], axis=0)
    good = (weight > 0.0) & (error < 9.0 * np.maximum(seen, 1))
    return InverseDepth(
        np.where(good, value, 0.0).astype(np.float32), np.where(good, weight, 0.0).astype(np.float32)
    )


def relative_pose(matches: Matches, camera: Camera) -> tuple[Float64, float] | None:
    """Return the other camera's motion from matches alone, and how many of them agree.

    What is nearly a plane, or near in depth for its distance, has two motions that fit almost alike
    (H. Longuet-Higgins, Proc. R. Soc. B 1986), and noise decides which of them an essential matrix has. So
    the search goes on from those of the plane that fits best, too, and the motion at the least cost counts.

    Returns:
        [4, 4] this camera's coordinates to the other's, with a translation of length 1, and the share of
        the matches that fit an essential matrix; None where there are too few.
    """
    here, there = _pairs(matches)
    if len(here) < 100:
        return None
    K = camera.matrix
    essential, agreeing = cv2.findEssentialMat(here, there, K, cv2.USAC_MAGSAC, 0.999, 0.5)
    if essential is None or essential.shape != (3, 3):
        return None
    share = float(agreeing.mean())
    _, R, t, _, _ = cv2.recoverPose(essential, here, there, K, distanceThresh=1e4, mask=agreeing)
    starts = [(np.asarray(R, np.float64), t[:, 0]), *_motions_by_a_plane(here, there, K)]
    step = max(1, len(here) // _REFINED)
    rays = [camera.rays(*points[::step].T) for points in (here, there)]
    found = [_least_cost(*start, *rays, focal=camera.fx) for start in starts]
    R, t, _ = min(found, key=lambda one: one[2])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, _towards_the_scene(R, t, *rays)
    return T, share


def _motions_by_a_plane(here: Float64, there: Float64, K: Float64) -> list[tuple[Float64, Float64]]:
    """Return rotation [3, 3] and translation [3] of the motions that explain matches of a plane."""
    H, _ = cv2.findHomography(here, there, cv2.USAC_MAGSAC, 1.0)
    if H is None:
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, K)
    lengths = [float(np.linalg.norm(t)) for t in translations]
    motions = zip(rotations, translations, lengths, strict=True)
    return [
        (np.array(R, np.float64), np.array(t[:, 0] / length, np.float64))
        for R, t, length in motions
        if length > 1e-9
    ]


def _least_cost(
    R: Float64, t: Float64, here: Float64, there: Float64, *, focal: float
) -> tuple[Float64, Float64, float]:
    """Return the motion near (R, t) at which rays [n, 3] lie nearest to their epipolar lines, and its cost.

    The distance is Sampson's, in pixels, under Cauchy's kernel.
    """
    cost = np.inf
    for _ in range(_REFINEMENTS):
        across = np.linalg.svd(t[None])[2][1:]

        def moved(
            step: Float64, R: Float64 = R, t: Float64 = t, across: Float64 = across
        ) -> tuple[Float64, Float64]:
            other = t + step[3:] @ across
            return se3.so3_exp(step[:3]) @ R, other / np.linalg.norm(other)

        def distances(step: Float64, moved: Callable[..., tuple[Float64, Float64]] = moved) -> Float64:
            turned, other = moved(step)
            E = se3.hat(other) @ turned
            lines, back = here @ E.T, there @ E
            slopes2 = lines[:, 0] ** 2 + lines[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2
            return focal * (there * lines).sum(axis=1) / np.sqrt(np.maximum(slopes2, 1e-12))

        found = least_squares(distances, np.zeros(5), loss="cauchy", f_scale=_PIXEL_NOISE, max_nfev=15)
        R, t = moved(found.x)
        cost = float(found.cost)
        if np.abs(found.x).max() < 1e-4:
            break
    return R, t, cost


def _towards_the_scene(R: Float64, t: Float64, here: Float64, there: Float64) -> Float64:
    """Return ``t`` or its opposite, whichever has more of the points before the camera."""
    turned = here @ R.T
    # d turned + t is along the other ray: cross products with it leave d.
    a, b = np.cross(there, turned), np.cross(there, t)
    return t if np.median(-(a * b).sum(axis=1)) > 0.0 else -t


def pose_from_depth(
    matches: Matches, depth: Float32, camera: Camera, start: Float64
) -> tuple[Float64, float] | None:
    """Return the other camera's motion from matches and this picture's depth [h, w] (0 = unknown).

    Args:
        start: [4, 4] where the search starts.

    Returns:
        [4, 4] this camera's coordinates to the other's, and the share of the matches that agree; None
        where there are too few.
    """
    rows, columns = _sampled(matches.good & (depth > 0.0))
    if len(rows) < 100:
        return None
    points = rays_of(camera)[rows, columns] * depth[rows, columns, None]
    rvec, tvec = se3.so3_log(start[:3, :3])[:, None].copy(), start[:3, 3][:, None].copy()
    found, rvec, tvec, agreeing = cv2.solvePnPRansac(
        points, matches.at[rows, columns].astype(np.float64), camera.matrix, None,
        rvec, tvec, True, 100, 1.5, 0.999,
    )  # fmt: skip
    if not found or agreeing is None:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = se3.so3_exp(rvec[:, 0]), tvec[:, 0]
    return T, len(agreeing) / len(rows)


def _sampled(where: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return at most about 4000 of the pixels, evenly."""
    rows, columns = np.nonzero(where)
    step = max(1, len(rows) // _SAMPLES)
    return rows[::step], columns[::step]


def _pairs(matches: Matches) -> tuple[Float64, Float64]:
    rows, columns = _sampled(matches.good)
    return np.stack([columns, rows], axis=1).astype(np.float64), matches.at[rows, columns].astype(np.float64)


def grey(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the brightness [h, w] of a picture ``rgb`` [h, w, 3]."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def filled(depth: Float32) -> Float32:
    """Return ``depth`` [h, w] with its gaps (0) filled smoothly from around; the median where it has none.

    Inverse depth is averaged over wider and wider surroundings until each gap has something.
    """
    known = depth > 0.0
    if not known.any():
        return depth
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=known)
    out, missing = inverse.copy(), ~known
    for sigma in (2.0, 6.0, 18.0, 54.0):
        weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma)
        mean = cv2.GaussianBlur(inverse, (0, 0), sigma) / np.maximum(weight, 1e-6)
        here = missing & (weight > 0.05)
        out[here] = mean[here]
        missing &= ~here
    out[missing] = np.median(inverse[known])
    return (1.0 / out).astype(np.float32)
