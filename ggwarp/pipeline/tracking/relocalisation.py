# SPDX-License-Identifier: Apache-2.0
"""Small pictures of where the camera has been: where a frame could be, and whether a pose can be true.

Registration says how much of a frame lies on the map. That is not enough where little does: a wrong pose may
lay one wall on another. Here a pose is checked against views: neither of two views may see through what the
other one sees, and where their surfaces agree, so must their brightness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pose_correction import PoseCorrection
from ggwarp.runtime.state import Stateful, state_value
from ggwarp.types import Float32, Float64, Frame

MAX_CANDIDATES = 8
"""A frame is registered from so many poses at most, the best by their small pictures."""

_WIDTH = 64
"""Width of a remembered view, pixels; its height follows."""

_SAMPLES = 4
"""Its brightness is the mean of so many samples a row and column, at least, of the picture's pixels."""

_APART = 0.3
"""A view is remembered when it is farther from all others than this, metres and radians."""

_SIMILAR = 4
"""So many of the most similar views are taken as places where the camera could be."""

_TURNS = (0.0, 0.2, 0.4, 0.6)
"""Angles to either side, from every such place, radians; up and down half of all but the largest."""

_TOLERANCE, _TOLERANCE_GROWTH = 0.05, 0.03
"""Depths agree that differ by no more than this at no distance, metres, and so much more per metre."""

_COMPARED = 4
"""A pose is compared with so many nearest views."""

_MIN_SHARED = 0.1
"""A pose at which a smaller share of a frame agrees with a remembered view cannot be checked."""

_MAX_THROUGH = 0.15
"""A pose is wrong where a larger share of what both views show is seen through."""

_MIN_CORRELATION = 0.6
"""A pose is wrong where brightness correlates less, on surfaces that agree."""


@dataclass(frozen=True)
class ViewConsistency:
    """How a frame at some pose looks beside remembered views.

    Attributes:
        shared: the largest share of the frame's readings that lie on surfaces of one of the views.
        through: share of the readings in common that one of two views sees through.
        correlation: of brightness on agreeing surfaces, -1..1; 1 where there is no texture to compare.
    """

    shared: float = 0.0
    through: float = 0.0
    correlation: float = 1.0

    def __str__(self) -> str:
        return (
            f"{self.shared:.2f} shared, {self.through:.2f} seen through, correlation {self.correlation:.2f}"
        )

    @property
    def is_consistent(self) -> bool:
        """Whether a pose with such a view may be true."""
        return (
            self.shared >= _MIN_SHARED
            and self.through <= _MAX_THROUGH
            and self.correlation >= _MIN_CORRELATION
        )

    @property
    def score(self) -> float:
        """Larger is likelier."""
        return self.shared * (1.0 + max(self.correlation, 0.0)) * (1.0 - self.through) ** 2


@state_value
@dataclass(frozen=True)
class SmallView:
    """A small picture: grey and depth [h, w], points [n, 3] where depth is, and those pixels' grey [n]."""

    grey: Float32
    depth: Float32
    points: Float32
    shades: Float32


class SmallViews:
    """Makes small pictures of frames, and compares two of them."""

    def __init__(self, sensor_camera: Camera) -> None:
        """Frames' sensor depth is by ``sensor_camera``."""
        height = max(1, round(_WIDTH * sensor_camera.height / sensor_camera.width))
        self._camera = sensor_camera.resized(_WIDTH, height)

    def view(self, frame: Frame) -> SmallView:
        """Return the small picture of ``frame``, which has depth."""
        image = frame.depth if frame.sensor_depth is None else frame.sensor_depth
        assert image is not None, "tracked by depth"
        size = self._camera.width, self._camera.height
        depth = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
        step = max(1, frame.rgb.shape[1] // (_SAMPLES * _WIDTH))
        rgb = np.ascontiguousarray(frame.rgb[step // 2 :: step, step // 2 :: step])
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        grey = cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), (3, 3), 0.0)
        return self.of(np.asarray(grey, np.float32), np.asarray(depth, np.float32))

    def of(self, grey: Float32, depth: Float32) -> SmallView:
        """Return the small picture that has this ``grey`` and ``depth`` [h, w]."""
        v, u = np.nonzero(depth > 0.0)
        points = self._camera.back_project(u, v, depth[v, u]).astype(np.float32)
        return SmallView(grey, depth, points, grey[v, u])

    def compare(
        self,
        view: SmallView,
        others: Sequence[SmallView],
        motions: Sequence[Float64],
        *,
        slack: float = 1.0,
        thinning: int = 1,
    ) -> ViewConsistency:
        """Return how ``view`` looks beside the ``others``.

        Args:
            motions: [4, 4] from the camera of ``view`` to that of each of the others.
            slack: how much larger differences of depth may be.
            thinning: the others' points that are looked at, every so many-th.
        """
        shared, correlation = 0.0, 1.0
        seen = through = 0
        for other, T in zip(others, motions, strict=True):
            here, there, passed = self._project(view, other, T, slack)
            back, _, passed_back = self._project(_thinned(other, thinning), view, se3.inverse(T), slack)
            through += passed + passed_back
            seen += passed + passed_back + len(here) + len(back)
            if len(here) > shared * len(view.points):
                shared, correlation = len(here) / len(view.points), _correlation(here, there)
        return ViewConsistency(shared, through / max(seen, 1), correlation)

    def _project(
        self, view: SmallView, other: SmallView, T: Float64, slack: float
    ) -> tuple[Float32, Float32, int]:
        """Return both greys where points of ``view`` agree with ``other``, and how many it sees through.

        Args:
            T: [4, 4] from the camera of ``view`` to that of ``other``.
        """
        x = view.points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        v, u, inside = self._camera.pixels_of(x)
        u, v, z, shades = u[inside], v[inside], x[inside, 2], view.shades[inside]
        seen = other.depth[v, u]
        gap = seen - z
        tolerance = slack * (_TOLERANCE + _TOLERANCE_GROWTH * z)
        agree = (seen > 0.0) & (np.abs(gap) < tolerance)
        passed = int(np.count_nonzero((seen > 0.0) & (gap >= tolerance)))
        return shades[agree], other.grey[v[agree], u[agree]], passed


class Relocaliser(Stateful):
    """Remembers small views with their poses."""

    STATE = ("_views", "_indices", "_poses", "_signatures")

    def __init__(self, sensor_camera: Camera) -> None:
        """Remember nothing yet; frames' sensor depth is by ``sensor_camera``."""
        self._pictures = SmallViews(sensor_camera)
        self._views: list[SmallView] = []
        self._indices: list[int] = []
        self._poses: Float64 = np.zeros((0, 4, 4))
        self._signatures: Float32 = np.zeros((0, 0), np.float32)

    def __len__(self) -> int:
        return len(self._views)

    def remember(self, frame: Frame, T_wc: Float64) -> None:
        """Keep the view of ``frame`` from ``T_wc`` [4, 4], unless one from nearly there is kept."""
        if len(self) and _distances(self._poses, T_wc).min() < _APART:
            return
        view = self._pictures.view(frame)
        signature = _signature(view)
        self._views.append(view)
        self._indices.append(frame.index)
        self._poses = np.concatenate([self._poses, T_wc[None]])
        self._signatures = np.concatenate([self._signatures.reshape(-1, len(signature)), signature[None]])

    def move(self, correction: PoseCorrection) -> None:
        """Let the views follow their frames."""
        if len(self):
            self._poses = correction.at(self._indices) @ self._poses

    def candidate_poses(self, frame: Frame, bases: list[Float64]) -> list[Float64]:
        """Return poses [4, 4] to register ``frame`` from, the likeliest first.

        Args:
            bases: poses about which to look, beside those of similar views.
        """
        view = self._pictures.view(frame)
        similar = np.argsort(-(self._signatures @ _signature(view)), kind="stable")[:_SIMILAR]
        side = sorted({s * a for a in _TURNS for s in (1.0, -1.0)}, key=lambda a: (abs(a), a))
        turns = [
            se3.se3_exp([0, 0, 0, up / 2.0, across, 0]) for across in side for up in side if abs(up) < 0.5
        ]
        poses = [base @ turn for base in [*bases, *self._poses[similar]] for turn in turns]
        coarse = _thinned(view, 4)
        scores = [self._compare(coarse, T, views=2, slack=3.0, thinning=4).score for T in poses]
        best: list[Float64] = []
        for i in np.argsort(-np.array(scores), kind="stable"):
            if all(_distances(np.array([T]), poses[i])[0] > 0.1 for T in best):
                best.append(poses[i])
            if len(best) == MAX_CANDIDATES:
                break
        return best

    def verify(self, frame: Frame, T_wc: Float64) -> ViewConsistency:
        """Return how ``frame`` from ``T_wc`` [4, 4] compares with the nearest views."""
        return self._compare(self._pictures.view(frame), T_wc, views=_COMPARED)

    def _compare(
        self, view: SmallView, T_wc: Float64, *, views: int, slack: float = 1.0, thinning: int = 1
    ) -> ViewConsistency:
        nearest = np.argsort(_distances(self._poses, T_wc), kind="stable")[:views]
        return self._pictures.compare(
            view,
            [self._views[i] for i in nearest],
            [se3.inverse(self._poses[i]) @ T_wc for i in nearest],
            slack=slack,
            thinning=thinning,
        )


def _thinned(view: SmallView, step: int) -> SmallView:
    return view if step == 1 else SmallView(view.grey, view.depth, view.points[::step], view.shades[::step])


def _signature(view: SmallView) -> Float32:
    """Return a tiny picture of grey and nearness as a vector of length 1: products say what is alike."""
    nearness = np.divide(1.0, view.depth, out=np.zeros_like(view.depth), where=view.depth > 0.0)
    parts = []
    for image in (view.grey, nearness):
        small = cv2.resize(image, (16, 12), interpolation=cv2.INTER_AREA).ravel()
        small = small - small.mean()
        parts.append(small / max(float(np.linalg.norm(small)), 1e-6))
    return (np.concatenate(parts) / np.sqrt(2.0)).astype(np.float32)


def _distances(poses: Float64, T_wc: Float64) -> Float64:
    """Return [n] how far ``poses`` [n, 4, 4] are from ``T_wc``: the larger of metres and radians."""
    cosines = (np.einsum("nij,ij->n", poses[:, :3, :3], T_wc[:3, :3]) - 1.0) / 2.0
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.maximum(np.linalg.norm(poses[:, :3, 3] - T_wc[:3, 3], axis=1), angles)


def _correlation(a: Float32, b: Float32) -> float:
    """Return the correlation of ``a`` and ``b`` [n]; 1 where one of them is all but constant."""
    if len(a) < 20:
        return 1.0
    a, b = a - a.mean(), b - b.mean()
    deviations = float(np.sqrt((a * a).mean())), float(np.sqrt((b * b).mean()))
    if min(deviations) < 4.0:  # of 255: noise and rounding
        return 1.0
    return float((a * b).mean() / (deviations[0] * deviations[1]))
