# SPDX-License-Identifier: Apache-2.0
"""Seeding in NumPy and OpenCV: what the kernels are compared with."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.objects.classifier import IdentitySeeds
from ggwarp.pipeline.mapping.seeding import DEPTH_TOLERANCE, SeedingConfig
from ggwarp.types import Exposure, Float32, Float64, Frame, Rendered

_NEUTRAL = Exposure()

_DETAIL_GAIN = 6.0
_RESIDUAL_THRESHOLD, _RESIDUAL_GAIN = 0.06, 1.5
_MOST = 1.0
_SPACING, _FLATNESS, _MAX_STRETCH = 0.5, 0.2, 3.0
_OPACITY = 0.7


def seed_density(
    frame: Frame,
    rendered: Rendered | None,
    config: SeedingConfig,
    exposure: Exposure = _NEUTRAL,
    *,
    present: Float32 | None = None,
) -> Float32:
    """Return the density of new Gaussians, [h, w] Gaussians a pixel, 0 where depth is missing.

    Args:
        frame: the keyframe, at the map's image size.
        rendered: the map's view from there; None while the map is empty.
        exposure: of the frame's picture.
        present: [h, w] Gaussians a pixel on the surface already; None: none.
    """
    assert frame.depth is not None
    colour = exposure.undo_exposure(frame.rgb)
    smooth = np.asarray(cv2.GaussianBlur(colour, (0, 0), 1.0), np.float32)
    contrast = cv2.blur(_mean_difference(colour, smooth), (3, 3))
    fresh = np.clip(config.min_density + _DETAIL_GAIN * contrast, 0.0, config.max_density)
    if rendered is None:
        density = fresh
    else:
        in_front = (rendered.median_depth - frame.depth) > DEPTH_TOLERANCE * rendered.median_depth
        is_new = (rendered.opacity < 0.5) | in_front
        residual = cv2.blur(_mean_difference(rendered.rgb, colour), (3, 3))
        more = np.clip(_RESIDUAL_GAIN * (residual - _RESIDUAL_THRESHOLD), 0.0, config.max_density)
        if present is not None:
            fresh = np.maximum(fresh - present, 0.0)
            more = np.minimum(more, np.maximum(_MOST - present, 0.0))
        density = np.where(is_new, fresh, more)
    return np.where(frame.depth > 0.0, density, 0.0).astype(np.float32)


def _mean_difference(one: Float32, other: Float32) -> Float32:
    """Return [h, w] the mean absolute difference of two pictures' channels [h, w, 3]."""
    difference = cv2.absdiff(one, other)  # NumPy's mean over so short an axis takes four times as long
    total = difference[..., 0] + difference[..., 1] + difference[..., 2]
    return np.asarray(total / np.float32(3.0), np.float32)


def choose_pixels(density: Float32, frame_index: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return (rows, columns) drawn at ``density`` by a low-discrepancy dither, repeatably."""
    v, u = np.nonzero(density)
    # Roberts' R2 sequence over the pixel grid: evenly spread at every density, unlike noise.
    dither = (u * 0.7548776662466927 + v * 0.5698402909980532 + frame_index * 0.6180339887498949) % 1.0
    drawn = dither < density[v, u]
    return v[drawn], u[drawn]


def surface_normals(
    depth: Float32, camera: Camera, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> Float32:
    """Return [n, 3] unit normals at pixels, in the camera frame, towards the camera; 0 where unknown.

    Args:
        depth: [h, w] metres, 0 = none.
        rows, columns: [n] the pixels.
    """
    smooth = cv2.bilateralFilter(depth, 5, 0.05, 2.0)

    def points(v: NDArray[np.intp], u: NDArray[np.intp]) -> Float32:
        return camera.back_project(u.astype(np.float32), v.astype(np.float32), smooth[v, u])

    last_row, last_column = depth.shape[0] - 1, depth.shape[1] - 1
    du = points(rows, np.minimum(columns + 1, last_column)) - points(rows, np.maximum(columns - 1, 0))
    dv = points(np.minimum(rows + 1, last_row), columns) - points(np.maximum(rows - 1, 0), columns)
    normals = np.cross(du, dv)
    # Across a depth edge the differences span two surfaces.
    reach = 0.1 * smooth[rows, columns]
    length = np.linalg.norm(normals, axis=1)
    broken = (np.abs(du[:, 2]) > reach) | (np.abs(dv[:, 2]) > reach)
    broken |= (depth[rows, columns] <= 0.0) | (length < 1e-12)
    normals /= np.where(broken, 1.0, length)[:, None]
    normals *= -np.sign((normals * points(rows, columns)).sum(axis=1, keepdims=True))
    normals[broken] = 0.0
    return normals


def seed_gaussians(
    frame: Frame,
    T_wc: Float64,
    camera: Camera,
    density: Float32,
    config: SeedingConfig,
    *,
    identities: IdentitySeeds | None,
    rng: np.random.Generator,
    exposure: Exposure = _NEUTRAL,
    keyframe_id: int = 0,
    flat: bool = True,
    present: Float32 | None = None,
) -> Gaussians:
    """Return the Gaussians that ``frame`` adds at ``density`` (GG-SLAM 2.3, c).

    Args:
        frame: the keyframe, at the map's image size.
        T_wc: [4, 4] its pose.
        density: [h, w] Gaussians a pixel.
        identities: what they begin as; None: they have none.
        rng: draws the identities.
        exposure: of the frame's picture.
        keyframe_id: number of the keyframe.
        flat: they are discs on the surface; else they are round, as where normals are not known.
        present: [h, w] Gaussians a pixel on the surface already, between which they go; None: none.
    """
    assert frame.depth is not None
    rows, cols = choose_pixels(density, frame.index)
    z = frame.depth[rows, cols]
    points = camera.back_project(cols, rows, z)
    normals = surface_normals(frame.depth, camera, rows, cols)
    towards = -points / np.linalg.norm(points, axis=1, keepdims=True)
    unknown = ~normals.any(axis=1)
    normals[unknown] = towards[unknown]

    axes, cosine = _surface_axes(normals, towards)
    total = density if present is None else density + present
    spread = _SPACING / np.sqrt(total[rows, cols]) * z / camera.fx
    flatness, max_stretch = (_FLATNESS, _MAX_STRETCH) if flat else (1.0, 1.0)
    stretch = np.minimum(1.0 / np.maximum(cosine, 1e-3), max_stretch)
    scales = np.stack([spread * stretch, spread, spread * flatness], axis=1)
    R, t = T_wc[:3, :3], T_wc[:3, 3]
    count = len(z)
    return Gaussians(
        means=(points @ R.T + t).astype(np.float32),
        quats=quats_from_matrices(R @ axes),
        log_scales=np.log(np.maximum(scales, 1e-5)).astype(np.float32),
        opacity_logits=np.full(count, np.log(_OPACITY / (1.0 - _OPACITY)), np.float32),
        colours=((exposure.undo_exposure(frame.rgb[rows, cols]) - 0.5) / SH_C0).astype(np.float32),
        identities=None if identities is None else _identities(identities, rows, cols, config, rng),
        keyframe_ids=np.full(count, keyframe_id, np.int32),
        votes=None
        if identities is None or identities.votes is None
        else (identities.votes[rows, cols] >= 0).astype(np.int32),
    )


def _identities(
    seeds: IdentitySeeds,
    rows: NDArray[np.intp],
    cols: NDArray[np.intp],
    config: SeedingConfig,
    rng: np.random.Generator,
) -> Float32:
    noise = (_uniform(int(rng.integers(2**31)), len(rows), 16) - 0.5) / np.float32(SH_C0)
    if seeds.classes is None:
        return noise
    classes = seeds.classes[rows, cols]
    known = (classes >= 0)[:, None]
    mixed = (1.0 - config.identity_noise) * seeds.codes[
        np.maximum(classes, 0)
    ] + config.identity_noise * noise
    return np.where(known, mixed, noise).astype(np.float32)


def _uniform(seed: int, count: int, draws: int) -> Float32:
    """Return [count, draws] of Warp's numbers in 0..1: PCG, a generator a row."""
    state = _pcg(np.uint32(seed) + _pcg(np.arange(count, dtype=np.uint32)))
    drawn = []
    for _ in range(draws):
        state = _pcg(state)
        drawn.append((state >> np.uint32(8)).astype(np.float32) / np.float32(2**24))
    return np.stack(drawn, axis=1)


def _pcg(state: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the generator's next [n] (M. Jarzynski and M. Olano, JCGT 9(3), 2020)."""
    b = state * np.uint32(747796405) + np.uint32(2891336453)
    c = ((b >> ((b >> np.uint32(28)) + np.uint32(4))) ^ b) * np.uint32(277803737)
    return (c >> np.uint32(22)) ^ c


def _surface_axes(normals: Float32, towards: Float32) -> tuple[Float32, Float32]:
    """Return [n, 3, 3] axes (columns: downhill, level, normal) and the cosine of incidence [n]."""
    cosine = np.clip((normals * towards).sum(axis=1), 0.0, 1.0)
    downhill = towards - cosine[:, None] * normals
    flat = np.linalg.norm(downhill, axis=1) < 1e-3
    # Seen head on, any tangent serves.
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    downhill[flat] = np.cross(normals[flat], helper[flat])
    downhill /= np.linalg.norm(downhill, axis=1, keepdims=True)
    return np.stack([downhill, np.cross(normals, downhill), normals], axis=2), cosine


def quats_from_matrices(R: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return [n, 4] unit quaternions, w first, of the rotations ``R`` [n, 3, 3] (Shepperd)."""
    d0, d1, d2 = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    squares = np.stack([1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2], axis=1)
    pivot = squares.argmax(axis=1)
    a, b, c = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    d, e, f = R[:, 1, 0] + R[:, 0, 1], R[:, 0, 2] + R[:, 2, 0], R[:, 2, 1] + R[:, 1, 2]
    s0, s1, s2, s3 = squares.T
    candidates = np.stack(
        [
            np.stack([s0, a, b, c], axis=1),
            np.stack([a, s1, d, e], axis=1),
            np.stack([b, d, s2, f], axis=1),
            np.stack([c, e, f, s3], axis=1),
        ],
        axis=1,
    )
    quats = candidates[np.arange(len(R)), pivot]
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
