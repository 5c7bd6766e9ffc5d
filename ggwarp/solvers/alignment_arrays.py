# SPDX-License-Identifier: Apache-2.0
"""The arrays of a direct alignment, and the two copies between host and device that one takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ggwarp.geometry import se3
from ggwarp.kernels.photometric import alignment, alignment_loop
from ggwarp.runtime.packed_arrays import PackedArrays, as_rows
from ggwarp.solvers.pose_equations import Prior, System
from ggwarp.types import Float64

_UPPER = np.triu_indices(alignment.PARAMETERS)


@dataclass(frozen=True)
class Comparison:
    """How pictures are compared; see :class:`ggwarp.kernels.photometric.alignment.AlignmentProblem`.

    Attributes:
        colour_noise, depth_noise: standard deviations, 0..1 and metres; depth is not compared where 0.
        robust_scale: standard deviations.
        edge, agreement: shares of a depth.
    """

    colour_noise: float
    depth_noise: float
    robust_scale: float
    edge: float
    agreement: float


@dataclass(frozen=True)
class Reference:
    """What a picture is aligned to.

    Attributes:
        levels: its views, finest first; see :mod:`ggwarp.kernels.photometric.image_pyramid`.
        T_cw: [4, 4] world to camera.
        rows: [sizes] :class:`ggwarp.kernels.photometric.alignment.AlignmentView`: where the views are, and
            what is compared with them.
    """

    levels: list[Any]
    T_cw: Float64
    rows: NDArray[Any]


def view_rows(rendered: Sequence[Any], observed: Sequence[Any]) -> NDArray[Any]:
    """Return :attr:`Reference.rows` of views of some sizes, each with what is compared with it."""
    view_type: Any = alignment.AlignmentView
    views = []
    for one, other in zip(rendered, observed, strict=True):
        views.append(view_type())
        views[-1].rendered, views[-1].observed = one, other
    return as_rows(view_type, views)


class AlignmentLoopArrays:
    """What alignments to up to so many references work on: a copy each way.

    Attributes:
        loop: for :mod:`ggwarp.kernels.photometric.alignment_loop`.
        references: how many there is room for.
    """

    def __init__(self, references: int, sizes: Sequence[alignment.AlignmentSize], device: Any) -> None:
        """Allocate for pictures of ``sizes``, finest first."""
        number: Any = wp.float64
        self.references = references
        self._packed = PackedArrays(
            {
                "problem": (alignment.AlignmentProblem, 1),
                "views": (alignment.AlignmentView, (len(sizes), references)),
                "origins": (wp.mat44d, references),
                "T_cw": (wp.mat44d, 1),
                "exposures": (wp.vec2d, references),
                "systems": (number, (references, alignment.SUMS)),
                "state": (wp.int32, alignment_loop.STATES),
            },
            device,
        )
        rows = references * max(size.items for size in sizes)
        shape = references, alignment.FOLDED, alignment.SUMS
        self.loop = alignment.AlignmentArrays(
            **self._packed.device,
            sums=wp.empty((rows, alignment.SUMS), dtype=float, device=device),
            folded=wp.empty(shape, dtype=number, device=device),
        )

    def load(
        self,
        references: Sequence[Reference],
        T_cw: Float64,
        exposures: Sequence[tuple[float, float]],
        comparison: Comparison,
        prior: Prior | None = None,
        *,
        fit_exposure: bool = True,
    ) -> None:
        """Say what is aligned to ``references``, from ``T_cw`` [4, 4] and an exposure against each on."""
        host, count = self._packed.host, len(references)
        problem = host["problem"][0]
        for name, value in vars(comparison).items():
            problem[name] = value
        problem["fit_exposure"] = fit_exposure
        problem["information"] = 0.0 if prior is None else prior.information
        problem["known"] = se3.inverse(T_cw if prior is None else prior.T_cw)
        for r, reference in enumerate(references):
            host["views"][:, r] = reference.rows
            host["origins"][r] = se3.inverse(reference.T_cw)
        host["T_cw"][0], host["exposures"][:count] = T_cw, exposures
        self._packed.upload()

    def read(self, references: int) -> tuple[Float64, list[tuple[float, float]], Float64, NDArray[np.int32]]:
        """Return the pose [4, 4], (a, b) and the system of each reference, [n, SUMS], and the state."""
        found = self._packed.read()
        exposures = [(float(a), float(b)) for a, b in found["exposures"][:references]]
        return found["T_cw"][0], exposures, found["systems"][:references], found["state"]


def unpacked(system: Float64, pixels: float) -> System:
    """Return a system [SUMS] whose every pixel stands for ``pixels``."""
    numbers = system * pixels
    H = np.zeros((alignment.PARAMETERS, alignment.PARAMETERS))
    H[_UPPER] = numbers[:36]
    return System(
        H=H + np.triu(H, 1).T, gradient=numbers[36:44], cost=float(numbers[44]), pixels=int(numbers[45])
    )
