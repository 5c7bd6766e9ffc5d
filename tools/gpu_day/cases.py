# SPDX-License-Identifier: Apache-2.0
"""Small cases whose results on two devices are compared: each takes a device and returns named arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from benchmarking.inputs.scene import scene_camera, scene_gaussians, scene_mapper
from benchmarking.inputs.walls import walls_cloud, walls_target
from ggwarp import FrameReader, Slam, SlamConfig
from ggwarp.datasets import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.kernels.losses.rgbd import LOSS_COUNT, rgbd_loss
from ggwarp.kernels.raster.sampling import Sample
from ggwarp.kernels.workspaces import allocate_loss
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig
from ggwarp.pipeline.tracking.preprocess import ObservationConfig, observe
from ggwarp.solvers.registration import Registrar, RegistrationStage
from ggwarp.types import Frame

Arrays = dict[str, Any]
Case = Callable[[Any], Arrays]

CASES: dict[str, Case] = {}
"""Name -> case, in the order in which they are run."""

TOLERANCES: dict[str, dict[str, float]] = {
    "mapping": {"losses": 2e-3, "count": 0.02, "*": 5e-2},
    "registration": {"poses": 1e-7, "iterations": 0.1},
    "registration_direct": {"poses": 1e-7, "iterations": 0.1},
    "observation": {"*": 1e-4, "covariances": 1e-3, "normals": 1e-3},
    "office": {"poses": 1e-3, "gaussians": 0.02, "loss": 0.05, "rgb": 0.03, "objects": 0.1, "verdicts": 0.0},
}
"""Case -> array -> relative L2 that is allowed (absolute where the reference is 0); ``*``: all others."""

DEFAULT_TOLERANCE = 2e-4
STAGES = [RegistrationStage(0.3, 6, 1e-3, 30.0, thinning=3), RegistrationStage(0.08, 15, 1e-6, 3.0)]


def case(function: Case) -> Case:
    """Add ``function`` to :data:`CASES` under its name."""
    CASES[function.__name__] = function
    return function


def rendered(device: Any, *, identity: bool, stride: int | None = None) -> Arrays:
    """A view of 4,000 Gaussians, and the adjoint of random gradients of its image."""
    camera = scene_camera(160, 96)
    gaussians = GaussianMap(device=device, has_identity=identity, capacity=4000)
    gaussians.append(scene_gaussians(4000, camera, size=2.5, identity=identity))
    renderer = Renderer(gaussians, camera, identity=identity)
    T = renderer.pose_array(np.eye(4))
    renderer.provide(T)
    sample = None if stride is None else Sample(stride, wp.full(1, 1, dtype=int, device=device))
    renderer.image.zero_()
    renderer.forward(T, sample=sample)
    rng = np.random.default_rng(3)
    d_image = rng.normal(size=renderer.d_image.shape).astype(np.float32)
    d_image[:, camera.height :], d_image[:, :, camera.width :] = 0, 0
    renderer.d_image.assign(d_image)
    renderer.d_transmittance.assign(d_image[0] * 0.5)
    renderer.adjoint(T, pose=True)
    visible = renderer.ranks.numpy() >= 0
    arrays = {
        "image": renderer.plane(renderer.image),
        "transmittance": renderer.plane(renderer.transmittance),
        "median_depth": renderer.plane(renderer.median_depth),
        "visible": visible,
        "d_pose": renderer.d_pose.numpy(),
        "weights": renderer.weights.numpy() * visible,
    }
    for name in ("means", "quats", "log_scales", "opacity_logits", "colours", "identities"):
        gradient = getattr(renderer.gradients, name)
        if gradient is not None:
            rows = gradient.numpy().copy()
            rows[~visible] = 0
            arrays[f"d_{name}"] = rows
    return arrays


@case
def render_4(device: Any) -> Arrays:
    """Colour and depth."""
    return rendered(device, identity=False)


@case
def render_20(device: Any) -> Arrays:
    """Colour, depth and identity."""
    return rendered(device, identity=True)


@case
def render_20_sampled(device: Any) -> Arrays:
    """Identity on a quarter of the blocks."""
    return rendered(device, identity=True, stride=4)


@case
def loss(device: Any) -> Arrays:
    """Eq. (5)'s colour and depth terms and their slopes, with pixels without depth."""
    rng = np.random.default_rng(1)
    h, w, shape = 90, 150, (4, 96, 160)
    image = wp.array(rng.random(shape), dtype=float, device=device)
    colour = wp.array(rng.integers(0, 255, (h, w, 3)), dtype=wp.uint8, device=device)
    depth = rng.random((h, w)).astype(np.float32) * 3
    depth[depth < 0.4] = 0
    d_image = wp.full(shape, 9.0, dtype=float, device=device)
    losses = wp.zeros(LOSS_COUNT, dtype=float, device=device)
    rgbd_loss(
        image,
        colour,
        wp.array(depth, dtype=float, device=device),
        d_image=d_image,
        losses=losses,
        workspace=allocate_loss(h, w, device=device),
        depth_weight=4.0,
        device=device,
    )
    return {"losses": losses.numpy()[:4], "d_image": d_image.numpy()}


def make_mapper(device: Any, *, recorded: bool | None = None) -> Mapper:
    """Return a mapper with one keyframe of the scene of 4,000 Gaussians."""
    camera = scene_camera(160, 96)
    batch = scene_gaussians(4000, camera, size=2.5, identity=True)
    _, frame = scene_mapper(batch, camera, device=device)
    mapper = build_mapper(MapperConfig(), camera, device=device, use_identity=True, recorded=recorded)
    mapper.insert(frame, np.eye(4))
    return mapper


def mapped(device: Any, *, recorded: bool | None = None, iterations: int = 24) -> Arrays:
    """The map and its losses after ``iterations``."""
    mapper = make_mapper(device, recorded=recorded)
    losses = []
    for k in range(iterations):
        mapper.iterate()
        if k % 8 == 7:
            losses.append(mapper.synchronise())
    return {"losses": np.array(losses), "count": np.array(mapper.map.count)} | mapper.map.to_host().arrays()


@case
def mapping(device: Any) -> Arrays:
    """Loosely compared: Adam divides small numbers by small numbers."""
    return mapped(device)


def registered(device: Any, *, recorded: bool | None) -> Arrays:
    """Clouds of several sizes, one after another in one registrar's arrays."""
    rng = np.random.default_rng(7)
    registrar = Registrar(device=device, recorded=recorded)
    target = walls_target(rng, 4000, device)
    poses, iterations = [], []
    for n in (1000, 900, 1200, 4000, 700, 3999):
        T = se3.se3_exp(rng.normal(size=6) * 0.02)
        found = registrar.register(walls_cloud(rng, n, T, device), target, np.eye(4), STAGES)
        poses.append(found.T_wc)
        iterations.append(found.iterations)
    return {"poses": np.array(poses), "iterations": np.array(iterations)}


@case
def registration_direct(device: Any) -> Arrays:
    """Launch by launch."""
    return registered(device, recorded=False)


@case
def registration(device: Any) -> Arrays:
    """On CUDA one recorded graph with loops in it."""
    return registered(device, recorded=None)


@case
def observation(device: Any) -> Arrays:
    """A wavy wall with a strip of no depth, and the ellipses of its points."""
    camera = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
    y, x = np.mgrid[:240, :320].astype(np.float32)
    depth = (1.5 + 0.002 * x + 0.3 * np.sin(y / 40)).astype(np.float32)
    depth[:, 200:220] = 0.0
    observed = observe(depth, camera, ObservationConfig(points=3000), device=device)
    quats = observed.quats.numpy()
    return {
        "points": observed.cloud.points.numpy(),
        "pixels": observed.pixels.numpy(),
        "scales": observed.scales.numpy(),
        "normals": np.abs(2 * (quats[:, 1] * quats[:, 3] + quats[:, 0] * quats[:, 2])),
        "covariances": observed.cloud.covariances.numpy(),
    }


@case
def office(device: Any) -> Arrays:
    """The ray-caster and the whole system on six small frames."""
    dataset = SyntheticOffice(frames=120, scale=0.2, device=device)
    with FrameReader(dataset, range(6), scale=1.0) as reader:
        slam = Slam(SlamConfig(), reader.camera, reader.sensor_camera, device=device)
        frames = [frame for frame in reader if isinstance(frame, Frame)]  # first: one thread on the device
        reports = [slam.step(frame) for frame in frames]
    view = slam.render(reports[-1].T_wc)
    return {
        "poses": np.array([r.T_wc for r in reports]),
        "verdicts": np.array([str(r.verdict) == str(reports[0].verdict) for r in reports]),
        "gaussians": np.array([r.gaussians for r in reports]),
        "loss": np.array([r.loss for r in reports]),
        "rgb": view.rgb,
        "objects": view.objects,
    }
