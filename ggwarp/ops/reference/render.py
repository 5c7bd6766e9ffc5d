# SPDX-License-Identifier: Apache-2.0
"""The renderer in plain torch: slow, any float type, differentiated by autograd.

No tiles and no hand-written adjoint: every Gaussian is evaluated at every pixel. Use float64.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ggwarp.geometry.camera import Camera

SH_C0 = 0.28209479177387814
NEAR = 0.05
LOW_PASS = 0.3
SLOPE_LOW_PASS = 0.03
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4


@dataclass(frozen=True)
class ProjectedGaussians:
    """Gaussians on the screen.

    Attributes:
        means2d: [n, 2] pixels.
        conics: [n, 4] (a, b, c, opacity), see :func:`composite`.
        slopes: [n, 2] metres per pixel: of E[z | u, v], the depth given the pixel.
        depths: [n] camera z of the mean, metres.
        features: [n, C] colour, depth of the mean, identity.
        extents: [n, 2] half width and height of where alpha reaches 1/255, pixels; 0 when culled.
    """

    means2d: Tensor
    conics: Tensor
    slopes: Tensor
    depths: Tensor
    features: Tensor
    extents: Tensor

    @property
    def visible(self) -> Tensor:
        """[n] bool: not culled (it may still lie off the screen)."""
        return self.extents[:, 0] > 0


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Return rotations [n, 3, 3] of quaternions [n, 4], w first, normalised here."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def se3_exp(tau: Tensor) -> Tensor:
    """Return the motion [4, 4] of the twist ``tau`` [6] = (v, w)."""
    vx, vy, vz, wx, wy, wz = tau.unbind()
    zero = torch.zeros_like(vx)
    rows = [zero, -wz, wy, vx, wz, zero, -wx, vy, -wy, wx, zero, vz, zero, zero, zero, zero]
    return torch.linalg.matrix_exp(torch.stack(rows).reshape(4, 4))


def _frozen(slopes: Tensor, focal: float, centre: float, size: int) -> Tensor:
    margin = 0.15 * size / focal
    return slopes.clamp(-(centre + 0.5) / focal - margin, (size - 0.5 - centre) / focal + margin)


def project(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    colours: Tensor,
    identities: Tensor | None,
    T_cw: Tensor,
    camera: Camera,
) -> ProjectedGaussians:
    """Project Gaussians: arguments as :func:`ggwarp.ops.render`."""
    points = means @ T_cw[:3, :3].T + T_cw[:3, 3]
    x, y, z = points.unbind(-1)
    means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    zero = torch.zeros_like(z)
    slope_x = _frozen(x / z, camera.fx, camera.cx, camera.width)
    slope_y = _frozen(y / z, camera.fy, camera.cy, camera.height)
    jacobians = torch.stack(
        [camera.fx / z, zero, -camera.fx * slope_x / z, zero, camera.fy / z, -camera.fy * slope_y / z], -1
    ).reshape(-1, 2, 3)
    M = T_cw[:3, :3] @ quat_to_matrix(quats) * log_scales.exp()[:, None, :]
    W = jacobians @ M
    unit = torch.eye(2, dtype=means.dtype, device=means.device)
    covariances = W @ W.mT + LOW_PASS * unit
    inverses = torch.linalg.inv(covariances)
    slopes = torch.linalg.solve(W @ W.mT + SLOPE_LOW_PASS * unit, W @ M[:, 2, :, None])[..., 0]
    opacities = torch.sigmoid(opacity_logits)
    conics = torch.stack([inverses[:, 0, 0], inverses[:, 0, 1], inverses[:, 1, 1], opacities], -1)
    colour = (0.5 + SH_C0 * colours).clamp(min=0.0)
    parts = [colour, z[:, None]] + ([identities] if identities is not None else [])
    with torch.no_grad():
        visible = (z >= NEAR) & (opacities > ALPHA_MIN)
        reach = 2.0 * torch.log(255.0 * opacities).clamp(min=0.0)
        variances = torch.stack([covariances[:, 0, 0], covariances[:, 1, 1]], -1)
        extents = torch.sqrt(reach[:, None] * variances) * visible[:, None]
    return ProjectedGaussians(means2d, conics, slopes, z, torch.cat(parts, -1), extents)


def composite(
    means2d: Tensor,
    conics: Tensor,
    slopes: Tensor,
    depths: Tensor,
    features: Tensor,
    *,
    width: int,
    height: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend splats front to back.

    alpha = min(0.99, opacity exp(-(a dx^2 + c dy^2) / 2 - b dx dy)); contributions under 1/255 are
    skipped and a pixel is finished once its transmittance is under 1e-4. To the depth (channel 3) a splat
    contributes its own at the pixel: features[:, 3] + slopes . (dx, dy).

    Args:
        means2d, conics, slopes, depths, features: as in :class:`ProjectedGaussians`, any order.
        width, height: image size, pixels.

    Returns:
        Image [C, h, w], transmittance [h, w], median depth [h, w] (at the pixel, of the first splat
        after which the transmittance is under 0.5; 0 where there is none).
    """
    options = {"dtype": means2d.dtype, "device": means2d.device}
    v, u = torch.meshgrid(torch.arange(height, **options), torch.arange(width, **options), indexing="ij")
    image = torch.zeros(features.shape[1], height, width, **options)
    transmittance = torch.ones(height, width, **options)
    median_depth = torch.zeros(height, width, **options)
    for i in torch.argsort(depths.detach(), stable=True).tolist():
        dx, dy = u - means2d[i, 0], v - means2d[i, 1]
        a, b, c, opacity = conics[i].unbind()
        alpha = (opacity * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=ALPHA_MAX)
        counts = (alpha >= ALPHA_MIN) & (transmittance >= TRANSMITTANCE_MIN)
        alpha = torch.where(counts, alpha, torch.zeros_like(alpha))
        values = features[i][:, None, None].repeat(1, height, width)
        values[3] = values[3] + slopes[i, 0] * dx + slopes[i, 1] * dy
        image = image + values * (alpha * transmittance)
        after = transmittance * (1.0 - alpha)
        crosses = (transmittance >= 0.5) & (after < 0.5)
        median_depth = torch.where(crosses, values[3].detach(), median_depth)
        transmittance = after
    return image, transmittance, median_depth


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
    """The oracle of :func:`ggwarp.ops.render`: same arguments, same results."""
    if tau is not None:
        T_cw = se3_exp(tau) @ T_cw
    splats = project(means, quats, log_scales, opacity_logits, colours, identities, T_cw, camera)
    seen = splats.visible
    return composite(
        splats.means2d[seen],
        splats.conics[seen],
        splats.slopes[seen],
        splats.depths[seen],
        splats.features[seen],
        width=camera.width,
        height=camera.height,
    )
