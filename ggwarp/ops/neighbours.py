# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbours and neighbourhood ellipses of torch tensors."""

from __future__ import annotations

import torch
import warp as wp

from ggwarp.kernels.registration import covariance, hash_grid, k_nearest
from ggwarp.ops.tensors import as_quats, as_vectors, on_stream_of, warp_device


def knn(
    points: torch.Tensor, queries: torch.Tensor | None = None, *, k: int, cell_size: float | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Find the ``k`` nearest of ``points`` to each query, exactly, nearest first.

    Args:
        points: [n, 3] float32, contiguous, finite; not copied.
        queries: [m, 3] like ``points``; None: the points themselves (each finds itself first).
        cell_size: of the search grid, in the points' unit; None: chosen from the points' spread. Speed
            follows it, results do not.

    Returns:
        [m, k] int32 indices, -1 where there are fewer points, and [m, k] float32 squared
        distances, inf there.

    Raises:
        ValueError: k < 1, or a tensor of another shape, type or layout.
    """
    if k < 1:
        raise ValueError(f"knn: k = {k}, but at least 1 is needed")
    queries = points if queries is None else queries
    device = warp_device(points)
    targets, sources = as_vectors(points, "points"), as_vectors(queries, "queries")
    cell_size = cell_size or _cell_size(points, k)
    indices = torch.empty((len(queries), k), dtype=torch.int32, device=points.device)
    distances2 = torch.empty((len(queries), k), dtype=torch.float32, device=points.device)
    if not len(queries):
        return indices, distances2
    with on_stream_of(points):
        grid = hash_grid.allocate_hash_grid(len(points), device=device)
        hash_grid.build_hash_grid(grid, targets, cell_size=cell_size, device=device)
        k_nearest.find_k_nearest(
            grid,
            sources,
            k=k,
            indices=wp.from_torch(indices, dtype=wp.int32),
            distances2=wp.from_torch(distances2, dtype=wp.float32),
            device=device,
        )
    return indices, distances2


def ellipses(
    points: torch.Tensor, *, k: int = 10, cell_size: float | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Fit a Gaussian to each point's ``k`` nearest neighbours, itself among them.

    Args:
        points: [n, 3] float32, contiguous, finite; not copied.

    Returns:
        [n, 4] unit quaternions, w first, and [n, 3] standard deviations, falling: R diag(s^2) R^T is
        the neighbourhood's covariance. Divide by the middle one for GG-SLAM's eq. (1).
    """
    indices, _ = knn(points, k=k, cell_size=cell_size)
    quats = torch.empty((len(points), 4), dtype=torch.float32, device=points.device)
    scales = torch.empty((len(points), 3), dtype=torch.float32, device=points.device)
    if not len(points):
        return quats, scales
    vectors = as_vectors(points, "points")
    with on_stream_of(points):
        covariance.estimate_covariances(
            vectors,
            vectors,
            wp.from_torch(indices, dtype=wp.int32),
            quats=as_quats(quats, "quats"),
            scales=as_vectors(scales, "scales"),
            device=warp_device(points),
        )
    return quats, scales


def _cell_size(points: torch.Tensor, k: int) -> float:
    """Return a cell that holds about ``k`` points of a surface of the points' inner spread."""
    if len(points) < 2:
        return 1.0
    quantiles = torch.tensor([0.1, 0.9], device=points.device)
    # A sample is enough for an extent, and quantiles leave outliers out.
    sample = points.detach()[:: max(1, len(points) // 10_000)]
    low, high = torch.quantile(sample, quantiles, dim=0)
    extent = float((high - low).max())
    return max(extent * (k / len(points)) ** 0.5, 1e-6) if extent > 0.0 else 1.0
