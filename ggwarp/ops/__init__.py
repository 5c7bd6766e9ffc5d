# SPDX-License-Identifier: Apache-2.0
"""The kernels as torch functions, differentiable where that makes sense.

- :func:`render`: Gaussians [n, ...] and a camera to an image [C, h, w], transmittance and median depth.
- :func:`ssim`: two images [3, h, w] to their mean structural similarity.
- :func:`knn`: points [n, 3] and queries [m, 3] to indices and squared distances [m, k].
- :func:`gicp`: points [n, 3] with covariances [n, 3, 3] and Gaussians [m, ...] to the pose between them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ggwarp.ops.neighbours import knn
    from ggwarp.ops.registration import gicp
    from ggwarp.ops.rendering import render
    from ggwarp.ops.similarity import ssim

__all__ = ["gicp", "knn", "render", "ssim"]

# Each is imported when first asked for: its kernels are compiled only where it is used. No module may bear
# the name of a function, or importing the module would put it in the function's place.
_HOMES = {"gicp": "registration", "knn": "neighbours", "render": "rendering", "ssim": "similarity"}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"ggwarp.ops.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
