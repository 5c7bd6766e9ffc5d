# SPDX-License-Identifier: Apache-2.0
"""Rendering Gaussians as a differentiable torch function, on the tensors' own memory."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from ggwarp.geometry.camera import Camera
from ggwarp.kernels.camera import intrinsics_of
from ggwarp.kernels.math import vec6, vec16
from ggwarp.kernels.raster.composite import composite, composite_adjoint
from ggwarp.kernels.raster.project import TILE, Splats, project
from ggwarp.kernels.raster.project_adjoint import pose_levels, project_adjoint
from ggwarp.kernels.raster.tiles import TileArrays, TileCapacityError, bin_splats, tiles_across
from ggwarp.kernels.workspaces import allocate_slot_gradients, allocate_splats, allocate_tiles
from ggwarp.ops.tensors import in_quads, on_stream_of
from ggwarp.runtime.streams import to_host

_FIELDS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "means": (wp.vec3, (3,)),
    "quats": (wp.vec4, (4,)),
    "log_scales": (wp.vec3, (3,)),
    "opacity_logits": (wp.float32, ()),
    "colours": (wp.vec3, (3,)),
    "identities": (vec16, (16,)),
}
_SLOTS_PER_GAUSSIAN = 4


def render(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    colours: Tensor,
    identities: Tensor | None,
    T_cw: Tensor,
    camera: Camera,
    *,
    tau: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Render Gaussians as seen by a camera (EWA splatting, front-to-back blending, black background).

    All tensors are float32 on one device. Gradients flow to every Gaussian parameter and to ``tau``.

    Args:
        means: [n, 3] world frame, metres.
        quats: [n, 4] rotations, w first, any length but zero.
        log_scales: [n, 3] log of standard deviations, metres.
        opacity_logits: [n].
        colours: [n, 3] degree-0 spherical harmonics: colour = max(0, 0.5 + 0.2821 f).
        identities: [n, 16], or None.
        T_cw: [4, 4] world to camera; its gradient is had through ``tau``.
        camera: intrinsics and image size.
        tau: [6] *zeros*, the tangent (v, w) of T_cw <- Exp(tau) T_cw. After ``backward()``, ``tau.grad``
            is the pose's gradient; apply a step to ``T_cw``, not to ``tau``.

    Returns:
        image [C, h, w]: colour, expected depth (sum of weight times the camera z that the Gaussian is
        expected to have at the pixel, metres), identity; C = 4 or 20. transmittance [h, w].
        median_depth [h, w]: metres, 0 where the transmittance stays above 0.5; carries no gradient.

    Raises:
        ValueError: a tensor of the wrong shape, type or device; ``T_cw`` requires a gradient; ``tau`` is
            not zero.
    """
    wp.init()
    parameters = (means, quats, log_scales, opacity_logits, colours, identities)
    for (name, (_, row)), tensor in zip(_FIELDS.items(), parameters, strict=True):
        if tensor is not None:
            _check(name, tensor, (means.shape[0], *row), means.device)
    _check("T_cw", T_cw, (4, 4), means.device)
    if T_cw.requires_grad:
        raise ValueError("T_cw requires a gradient: pass tau=torch.zeros(6, requires_grad=True) instead")
    if tau is not None:
        _check("tau", tau, (6,), means.device)
        if bool(tau.any()):
            raise ValueError("tau is not zero: apply Exp(tau) to T_cw and pass zeros")
    image, transmittance, median_depth = _Render.apply(*parameters, T_cw, tau, camera)
    h, w = camera.height, camera.width
    return image[:, :h, :w], transmittance[:h, :w], median_depth[:h, :w]


def _check(name: str, tensor: Tensor, shape: tuple[int, ...], device: torch.device) -> None:
    if tensor.dtype != torch.float32 or tuple(tensor.shape) != shape or tensor.device != device:
        raise ValueError(
            f"{name}: {tensor.dtype} {list(tensor.shape)} on {tensor.device}, "
            f"but torch.float32 {list(shape)} on {device} is needed"
        )


def _view(tensor: Tensor, row_type: Any = wp.float32) -> Any:
    """Return the tensor's memory as a Warp array."""
    if not tensor.numel():
        # torch calls an empty tensor of any strides contiguous, Warp does not.
        tensor = tensor.new_empty(tensor.shape)
    return wp.from_torch(tensor.detach(), dtype=row_type, requires_grad=False)


def _views(tensors: list[Tensor | None]) -> list[Any]:
    """View the Gaussians' parameters, or their gradients."""
    types = (row_type for row_type, _ in _FIELDS.values())
    return [None if t is None else _view(t, row_type) for t, row_type in zip(tensors, types, strict=True)]


def _binned(splats: Splats, count: int, camera: Camera, device: Any) -> TileArrays:
    """Bin into arrays that are large enough: a second try when the first guess was too small."""
    size = {"width": camera.width, "height": camera.height}
    slots = _SLOTS_PER_GAUSSIAN * count
    while True:
        tiles = allocate_tiles(count, slots, **size, device=device)
        try:
            bin_splats(splats.tile_rects, splats.depths, count=count, **size, out=tiles)
        except TileCapacityError as error:
            slots = error.needed
            continue
        if device.is_cpu:
            return tiles
        _, needed, overflow, _ = to_host(tiles.counts).tolist()
        if not overflow:
            return tiles
        slots = needed


class _Render(torch.autograd.Function):
    """Returns padded planes: the caller's slicing also pads their gradients."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        opacity_logits: Tensor,
        colours: Tensor,
        identities: Tensor | None,
        T_cw: Tensor,
        tau: Tensor | None,
        camera: Camera,
    ) -> tuple[Tensor, Tensor, Tensor]:
        parameters = [
            None if t is None else in_quads(t)
            for t in (means, quats, log_scales, opacity_logits, colours, identities)
        ]
        T_cw = T_cw.contiguous()
        count, channels = means.shape[0], 4 if identities is None else 20
        shape = (tiles_across(camera.height) * int(TILE), tiles_across(camera.width) * int(TILE))
        image = means.new_zeros((channels, *shape))
        transmittance, median_depth = means.new_ones(shape), means.new_zeros(shape)
        with on_stream_of(means):
            arrays = _views(parameters)
            device = arrays[0].device
            splats = allocate_splats(count, device=device)
            project(
                *arrays,
                T_cw=_view(T_cw[None], wp.mat44),
                camera=intrinsics_of(camera),
                count=count,
                out=splats,
            )
            tiles = _binned(splats, count, camera, device)
            composite(
                splats,
                tiles,
                width=camera.width,
                height=camera.height,
                image=_view(image),
                transmittance=_view(transmittance),
                median_depth=_view(median_depth),
                identities=arrays[5],
            )
        ctx.save_for_backward(*parameters, T_cw, image, transmittance)
        ctx.splats, ctx.tiles, ctx.camera, ctx.wants_pose = splats, tiles, camera, tau is not None
        ctx.mark_non_differentiable(median_depth)
        return image, transmittance, median_depth

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grads: Tensor
    ) -> tuple[Tensor | None, ...]:
        *parameters, T_cw, image, transmittance = ctx.saved_tensors
        d_image, d_transmittance = (in_quads(g) for g in grads[:2])
        splats, tiles, camera = ctx.splats, ctx.tiles, ctx.camera
        count, channels = parameters[0].shape[0], image.shape[0]
        gradients = [None if t is None else torch.zeros_like(t) for t in parameters]
        d_tau = T_cw.new_zeros((1, 6)) if ctx.wants_pose else None
        with on_stream_of(image):
            arrays = _views(parameters)
            device = arrays[0].device
            pairs = int(to_host(tiles.counts)[1])
            slots = allocate_slot_gradients(pairs, channels, device=device)
            composite_adjoint(
                splats,
                tiles,
                image=_view(image),
                transmittance=_view(transmittance),
                d_image=_view(d_image),
                d_transmittance=_view(d_transmittance),
                out=slots,
                identities=arrays[5],
            )
            pose = ()
            if d_tau is not None:
                row: Any = vec6
                inner = [wp.empty(k, dtype=row, device=device) for k in pose_levels(count)[:-1]]
                pose = (*inner, _view(d_tau, row))
            outputs = (f"d_{name}" for name in _FIELDS)
            project_adjoint(
                *arrays[:5],
                T_cw=_view(T_cw[None], wp.mat44),
                camera=intrinsics_of(camera),
                count=count,
                tiles=tiles,
                slots=slots,
                **dict(zip(outputs, _views(gradients), strict=True)),
                d_pose_scratch=pose,
            )
        return (*gradients, None, None if d_tau is None else d_tau[0], None)
