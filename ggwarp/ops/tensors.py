# SPDX-License-Identifier: Apache-2.0
"""Torch tensors seen as Warp arrays, without copies."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
import warp as wp


def warp_device(tensor: torch.Tensor) -> Any:
    """Return the Warp device that ``tensor`` lies on."""
    return wp.get_device(str(tensor.device))


def on_stream_of(tensor: torch.Tensor) -> AbstractContextManager[Any]:
    """Order Warp's work with torch's: inside, launches go to torch's current stream."""
    if not tensor.is_cuda:
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device)))


def in_quads(tensor: torch.Tensor) -> torch.Tensor:
    """Return ``tensor`` such that kernels can read its memory 16 bytes at a time: itself, or else a copy.

    A copy is needed where it is strided, or begins within 16 bytes: part of a larger tensor.
    """
    tensor = tensor.contiguous()
    return tensor if tensor.data_ptr() % 16 == 0 else tensor.clone()


def as_vectors(tensor: torch.Tensor, name: str) -> Any:
    """Return [n, 3] float32 as [n] wp.vec3.

    Raises:
        ValueError: another shape, type or layout; ``name`` is named.
    """
    return _view(tensor, name, (3,), wp.vec3)


def as_quats(tensor: torch.Tensor, name: str) -> Any:
    """Return [n, 4] float32 as [n] wp.vec4, or raise ValueError."""
    return _view(tensor, name, (4,), wp.vec4)


def as_matrices(tensor: torch.Tensor, name: str) -> Any:
    """Return [n, 3, 3] float32 as [n] wp.mat33, or raise ValueError."""
    return _view(tensor, name, (3, 3), wp.mat33)


def _view(tensor: torch.Tensor, name: str, inner: tuple[int, ...], dtype: Any) -> Any:
    if tensor.ndim != 1 + len(inner) or tuple(tensor.shape[1:]) != inner:
        raise ValueError(
            f"{name}: shape {tuple(tensor.shape)}, but [n, {', '.join(map(str, inner))}] is needed"
        )
    if tensor.dtype != torch.float32:
        raise ValueError(f"{name}: {tensor.dtype}, but torch.float32 is needed")
    if not tensor.is_contiguous():
        raise ValueError(f"{name}: not contiguous; pass {name}.contiguous()")
    if len(tensor) == 0:
        return wp.empty(0, dtype=dtype, device=warp_device(tensor))
    return wp.from_torch(tensor.detach(), dtype=dtype)
