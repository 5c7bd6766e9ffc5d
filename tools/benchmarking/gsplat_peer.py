# SPDX-License-Identifier: Apache-2.0
"""gsplat's CUDA rasteriser on the same scene: time, and whether pictures and gradients agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarking.options import milliseconds
from benchmarking.record import Check, Record, Row, Section
from benchmarking.timing import measure
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import SH_C0
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.mapping.mapper import Mapper
from ggwarp.runtime.graphs import GraphCache

_DEPTH = 3
PICTURE_TOLERANCE, GRADIENT_TOLERANCE = 1e-3, 1e-2
"""Relative L2 distances up to which two rasterisers agree: their cut-offs are not the same to the bit."""

_NAMES = ("means", "quats", "log_scales", "opacity_logits", "colours", "identities")


@dataclass(frozen=True)
class Rendering:
    """A picture and the gradients of one function of it.

    Attributes:
        image: [C, h, w].
        gradients: name -> [n, ...] by the map's parameters.
    """

    image: Any
    gradients: dict[str, Any]


def relative_l2(value: Any, reference: Any) -> float:
    """Return |value - reference| / |reference|."""
    difference = np.asarray(value, np.float64) - np.asarray(reference, np.float64)
    return float(np.linalg.norm(difference) / max(np.linalg.norm(reference), 1e-30))


def agreement(ours: Rendering, theirs: Rendering) -> list[Row]:
    """Return a row for the picture and each gradient: relative L2 distance, and cosine."""
    pairs = {"picture": (ours.image, theirs.image)}
    pairs |= {f"d {n}": (g, theirs.gradients[n]) for n, g in ours.gradients.items()}
    rows = []
    for name, (a, b) in pairs.items():
        x, y = np.ravel(a).astype(np.float64), np.ravel(b).astype(np.float64)
        cosine = float(x @ y / max(np.linalg.norm(x) * np.linalg.norm(y), 1e-30))
        limit = PICTURE_TOLERANCE if name == "picture" else GRADIENT_TOLERANCE
        distance = relative_l2(a, b)
        rows.append({"what": name, "relative L2": distance, "cosine": cosine, "agrees": distance <= limit})
    return rows


class GsplatScene:
    """The scene as gsplat takes it: parameters already activated, one feature row a Gaussian.

    Its depth channel is the mean's depth at every pixel; ours is the splat's depth there.
    """

    def __init__(self, mapper: Mapper, camera: Camera, device: str) -> None:
        rows = mapper.map.to_host()

        def tensor(values: Any) -> torch.Tensor:
            return torch.tensor(np.asarray(values, np.float32), device=device, requires_grad=True)

        self.camera = camera
        self.means, self.quats = tensor(rows.means), tensor(rows.quats)
        self.scales = tensor(np.exp(rows.log_scales))
        self.opacities = tensor(1.0 / (1.0 + np.exp(-rows.opacity_logits)))
        parts = [0.5 + SH_C0 * rows.colours, rows.means[:, 2:]]
        if rows.identities is not None:
            parts.append(rows.identities)
        self.features = tensor(np.concatenate(parts, 1))
        # gsplat's pixel (0, 0) has its centre at (0.5, 0.5).
        K = [[camera.fx, 0.0, camera.cx + 0.5], [0.0, camera.fy, camera.cy + 0.5], [0.0, 0.0, 1.0]]
        self.Ks = torch.tensor([K], device=device)
        self.viewmats = torch.eye(4, device=device)[None]

    @property
    def leaves(self) -> list[torch.Tensor]:
        return [self.means, self.quats, self.scales, self.opacities, self.features]

    def forward(self) -> torch.Tensor:
        """Return the image [h, w, C]."""
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]

        image, _, _ = rasterization(
            *self.leaves,
            viewmats=self.viewmats,
            Ks=self.Ks,
            width=self.camera.width,
            height=self.camera.height,
            near_plane=0.05,
            eps2d=0.3,
            packed=False,
        )
        return image[0]

    def render(self, d_image: torch.Tensor) -> Rendering:
        """Return picture and gradients for ``d_image`` [h, w, C], by the map's own parameters."""
        image = self.forward()
        d_means, d_quats, d_scales, d_opacities, d_features = torch.autograd.grad(
            image, self.leaves, d_image.contiguous()
        )
        with torch.no_grad():
            gradients = {
                "means": d_means,
                "quats": d_quats,
                "log_scales": d_scales * self.scales,
                "opacity_logits": d_opacities * self.opacities * (1.0 - self.opacities),
                "colours": SH_C0 * d_features[:, :3],
                "identities": d_features[:, 4:],
            }
        found = {n: g.cpu().numpy() for n, g in gradients.items() if g.numel()}
        return Rendering(image.detach().permute(2, 0, 1).cpu().numpy(), found)


def our_rendering(mapper: Mapper, camera: Camera, d_image: Any) -> Rendering:
    """Return our picture and gradients for ``d_image`` [h, w, C]."""
    renderer = Renderer(mapper.map, camera)
    T_cw = renderer.pose_array(np.eye(4))
    renderer.provide(T_cw)
    renderer.forward(T_cw)
    padded = np.zeros(renderer.d_image.shape, np.float32)
    padded[:, : camera.height, : camera.width] = np.moveaxis(d_image, 2, 0)
    renderer.d_image.assign(padded)
    renderer.adjoint(T_cw)
    count = mapper.map.count
    seen = renderer.tiles.ranks.numpy()[:count] >= 0
    arrays = {n: getattr(renderer.gradients, n) for n in _NAMES}
    gradients = {}
    for name, array in arrays.items():
        if array is not None:
            rows = array.numpy()[:count].copy()
            rows[~seen] = 0.0
            gradients[name] = rows
    return Rendering(renderer.plane(renderer.image), gradients)


def compare(record: Record, mapper: Mapper, camera: Camera, *, rounds: int) -> None:
    """Add gsplat's times and the agreement to ``record``, or why there are none."""
    try:
        import gsplat  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        record.notes.append("gsplat was not compared: pip install gsplat")
        return
    device = f"cuda:{mapper.map.device.ordinal}"
    scene = GsplatScene(mapper, camera, device)
    channels = scene.features.shape[1]
    d_image = np.random.default_rng(2).normal(size=(camera.height, camera.width, channels))
    d_image = d_image.astype(np.float32)
    # The two mean different things by depth: it takes no part in the comparison.
    d_compared = d_image.copy()
    d_compared[..., _DEPTH] = 0.0
    theirs = scene.render(torch.tensor(d_compared, device=device))
    ours = our_rendering(mapper, camera, d_compared)
    for rendering in (ours, theirs):
        rendering.image[_DEPTH] = 0.0
    rows = agreement(ours, theirs)
    record.sections.append(Section("agreement with gsplat", rows, "depth aside: gsplat's is the mean's"))

    renderer = Renderer(mapper.map, camera)
    T_cw = renderer.pose_array(np.eye(4))
    renderer.provide(T_cw)
    incoming = torch.tensor(d_image, device=device)

    graphs = GraphCache(mapper.map.device)

    def render_and_chain() -> None:
        renderer.forward(T_cw)
        renderer.adjoint(T_cw)

    def our_pass() -> None:
        graphs.run("pass", render_and_chain, arrays=renderer.allocation)

    times = measure(
        {
            "ours": our_pass,
            "gsplat": lambda: torch.autograd.grad(scene.forward(), scene.leaves, incoming),
        },
        device=wp.get_device(device),
        rounds=rounds,
    )
    record.sections.append(
        Section(
            "forward + adjoint beside gsplat",
            [{"rasteriser": name, **milliseconds(t)} for name, t in times.items()],
            f"{channels} channels each; ours recorded, gsplat from activated parameters by autograd",
        )
    )
    agrees = all(row["agrees"] for row in rows)
    note = "same picture and gradients" if agrees else "the results DIFFER: see the agreement"
    record.checks.append(
        Check("forward + adjoint / gsplat's", times["ours"].over(times["gsplat"]), "<=", 1.0, "x", note)
    )
