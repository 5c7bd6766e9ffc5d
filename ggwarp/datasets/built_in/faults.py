# SPDX-License-Identifier: Apache-2.0
"""Faults of real sensors and of real object masks, as pure functions on images.

Each takes its randomness as a generator, so that a frame's faults depend on (seed, frame index)
alone, whatever the order of access.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.geometry.camera import Camera
from ggwarp.types import Float32

Ids = NDArray[np.int32]
Rgb = NDArray[np.uint8]


@dataclass(frozen=True)
class SensorFaults:
    """What is wrong with the camera. Everything is off by default."""

    depth_noise: float = 0.0
    """Depth has normal noise of this times z^2, in metres (a Kinect: about 0.0015)."""

    grazing_holes: float = 0.0
    """There is no depth where a surface, or an edge, is seen at less than this angle in degrees."""

    disparity_step: float = 0.0
    """Depth is rounded to this step of disparity in pixels (a Kinect: 0.125)."""

    disparity_constant: float = 43.5
    """The depth sensor's focal length times its baseline, in pixels metres."""

    colour_noise: float = 0.0
    """Colour has normal noise of this standard deviation, in 8-bit levels."""

    exposure_drift: float = 0.0
    """The gain of the pictures swings by this share either way."""

    exposure_swings: float = 1.0
    """The gain swings so often over the sequence."""

    seed: int = 0
    """The seed of all these faults."""


@dataclass(frozen=True)
class MaskFaults:
    """What is wrong with the object masks. Everything is off by default.

    Attributes:
        dots: share of the pixels covered by dots of a wrong id.
        dot_radius: largest radius of a dot, pixels.
        ragged: how far edges stray, pixels.
        dropped: share of object-frames without a mask.
        swapped: share of object-frames that carry the id of another object in view.
        shuffled: ids are drawn anew in every frame, so they say nothing across frames.
        missing: share of frames without any mask.
        reborn: share of the objects that carry a new id from frame ``changed_at`` on.
        stolen: share of the objects whose id the next object carries from frame ``changed_at`` on, itself
            a new one: a track that slipped from one object to another for good.
        changed_at: the frame's index.
        shared: share of the objects that carry the id of another one all along.
        seed: of all the randomness.
    """

    dots: float = 0.0
    dot_radius: int = 2
    ragged: float = 0.0
    dropped: float = 0.0
    swapped: float = 0.0
    shuffled: bool = False
    missing: float = 0.0
    reborn: float = 0.0
    stolen: float = 0.0
    changed_at: int = 0
    shared: float = 0.0
    seed: int = 0


def noisy_depth(depth: Float32, sigma: float, rng: np.random.Generator) -> Float32:
    """Return depth with normal noise of ``sigma`` z^2, metres; pixels without depth stay so."""
    noise = rng.standard_normal(depth.shape, np.float32)
    return np.where(depth > 0, np.maximum(depth + np.float32(sigma) * depth**2 * noise, 1e-3), 0).astype(
        np.float32
    )


def quantised_depth(depth: Float32, step: float, constant: float) -> Float32:
    """Return depth rounded to ``step`` pixels of disparity (``constant`` / z); 0 where there is none."""
    disparity = np.divide(constant, depth, out=np.zeros_like(depth), where=depth > 0)
    rounded = np.round(disparity / step) * step
    return np.divide(constant, rounded, out=np.zeros_like(depth), where=rounded > 0).astype(np.float32)


def holed_depth(depth: Float32, true_depth: Float32, camera: Camera, angle: float) -> Float32:
    """Return depth without the pixels whose surface is seen at less than ``angle`` degrees.

    Args:
        depth: [h, w] metres, to be holed.
        true_depth: [h, w] metres, free of noise: tells the slopes.
        camera: of both.
    """
    slope = np.zeros_like(true_depth)
    near = np.maximum(true_depth, 1e-6)
    # Depth per metre across the line of sight, on either side of the pixel: edges count as slopes.
    for axis, focal in ((0, camera.fy), (1, camera.fx)):
        step = np.abs(np.diff(true_depth, axis=axis)) * np.float32(focal)
        ahead = np.pad(step, [(0, 1 - axis), (0, axis)])
        behind = np.pad(step, [(1 - axis, 0), (axis, 0)])
        slope = np.maximum(slope, np.maximum(ahead, behind) / near)
    return np.where(slope > 1.0 / np.tan(np.radians(angle)), np.float32(0), depth)


def noisy_colour(rgb: Rgb, sigma: float, rng: np.random.Generator) -> Rgb:
    """Return colour with normal noise of ``sigma`` 8-bit levels."""
    noise = rng.standard_normal(rgb.shape, np.float32) * np.float32(sigma)
    return np.clip(np.round(rgb + noise), 0, 255).astype(np.uint8)


def exposed(rgb: Rgb, gain: float) -> Rgb:
    """Return colour times ``gain``, clipped."""
    return np.clip(np.round(rgb * np.float32(gain)), 0, 255).astype(np.uint8)


def dotted(mask: Ids, share: float, radius: int, ids: Ids, rng: np.random.Generator) -> Ids:
    """Return the mask with about ``share`` of it under dots of random ``ids`` (0 among them)."""
    out = mask.copy()
    radii = np.arange(1, radius + 1)
    canvas = np.zeros((2 * radius + 3, 2 * radius + 3), np.uint8)
    middle = (radius + 1, radius + 1)
    areas = [np.count_nonzero(cv2.circle(canvas * 0, middle, int(r), 1, -1)) for r in radii]
    # Dots overlap: n of them leave a share exp(-n area / size) free.
    count = rng.poisson(-np.log1p(-share) * mask.size / np.mean(areas))
    choices = np.append(ids, 0)
    for _ in range(count):
        centre = (int(rng.integers(mask.shape[1])), int(rng.integers(mask.shape[0])))
        cv2.circle(out, centre, int(rng.choice(radii)), int(rng.choice(choices)), -1)
    return out


def ragged(mask: Ids, pixels: float, rng: np.random.Generator) -> Ids:
    """Return the mask with edges that stray by up to about ``pixels``, in lumps of a few pixels."""
    h, w = mask.shape
    coarse = rng.standard_normal((2, h // 3 + 2, w // 3 + 2), np.float32)
    shift = [cv2.resize(c, (w, h), interpolation=cv2.INTER_LINEAR) * (0.6 * pixels) for c in coarse]
    v, u = np.mgrid[0:h, 0:w]
    rows = np.clip(np.round(v + np.clip(shift[0], -pixels, pixels)), 0, h - 1).astype(np.intp)
    columns = np.clip(np.round(u + np.clip(shift[1], -pixels, pixels)), 0, w - 1).astype(np.intp)
    return mask[rows, columns]


def relabelled(mask: Ids, names: dict[int, int]) -> Ids:
    """Return the mask with every id in ``names`` replaced by what it maps to, all at once."""
    table = np.arange(max(int(mask.max(initial=0)), *names, 0) + 1, dtype=np.int32)
    for old, new in names.items():
        table[old] = new
    return table[mask]


def changed_names(ids: Ids, reborn: float, stolen: float, rng: np.random.Generator) -> dict[int, int]:
    """Return the new id of each object whose track breaks for good.

    Args:
        ids: [n] all ids of the sequence, distinct, at least 1.
        reborn, stolen: as of :class:`MaskFaults`.
        rng: two numbers an object are drawn.
    """
    objects: list[int] = ids.tolist()
    dice = rng.random((2, len(objects)))
    fresh = max(objects, default=0) + 1
    names: dict[int, int] = {}
    for k, identifier in enumerate(objects):
        if identifier in names:
            continue
        heir = objects[(k + 1) % len(objects)]
        if dice[0, k] < reborn:
            names[identifier] = fresh + k
        elif dice[1, k] < stolen and heir != identifier and heir not in names:
            names[identifier], names[heir] = fresh + k, identifier
    return names


def shared_names(ids: Ids, share: float, rng: np.random.Generator) -> dict[int, int]:
    """Return the id of another object for about ``share`` of ``ids`` [n]; that one keeps its own."""
    others = ids[rng.permutation(ids.size)].tolist()
    names: dict[int, int] = {}
    for identifier, other, die in zip(ids.tolist(), others, rng.random(ids.size), strict=True):
        if die < share and other != identifier and other not in names and identifier not in names.values():
            names[identifier] = other
    return names


def faulty_mask(mask: Ids, faults: MaskFaults, index: int, ids: Ids) -> Ids | None:
    """Return a frame's mask with its faults; None where it goes missing.

    Args:
        mask: [h, w] true ids.
        faults: which.
        index: the frame's index.
        ids: all ids of the sequence.
    """
    if np.random.default_rng([faults.seed, 3, index]).random() < faults.missing:
        return None
    rng = np.random.default_rng([faults.seed, 2, index])
    if (faults.reborn > 0 or faults.stolen > 0) and index >= faults.changed_at:
        breaks = np.random.default_rng([faults.seed, 4])
        mask = relabelled(mask, changed_names(ids, faults.reborn, faults.stolen, breaks))
    if faults.shared > 0:
        mask = relabelled(mask, shared_names(ids, faults.shared, np.random.default_rng([faults.seed, 5])))
    seen = np.unique(mask[mask > 0])
    dice = rng.random((2, seen.size))
    others = np.roll(seen, 1)
    names: dict[int, int] = {}
    for k, object_id in enumerate(seen.tolist()):
        if dice[0, k] < faults.dropped:
            names[object_id] = 0
        elif dice[1, k] < faults.swapped and seen.size > 1:
            names[object_id] = int(others[k])
    if names:
        mask = relabelled(mask, names)
    if faults.shuffled:
        mask = relabelled(mask, dict(zip(ids.tolist(), rng.permutation(ids).tolist(), strict=True)))
    if faults.ragged > 0:
        mask = ragged(mask, faults.ragged, rng)
    if faults.dots > 0:
        mask = dotted(mask, faults.dots, faults.dot_radius, ids, rng)
    return mask


def faulty_depth(depth: Float32, faults: SensorFaults, index: int, camera: Camera) -> Float32:
    """Return a frame's depth [h, w], metres, with the sensor's faults."""
    rng = np.random.default_rng([faults.seed, 0, index])
    out = depth
    if faults.depth_noise > 0:
        out = noisy_depth(out, faults.depth_noise, rng)
    if faults.disparity_step > 0:
        out = quantised_depth(out, faults.disparity_step, faults.disparity_constant)
    if faults.grazing_holes > 0:
        out = holed_depth(out, depth, camera, faults.grazing_holes)
    return out


def faulty_colour(rgb: Rgb, faults: SensorFaults, index: int, phase: float) -> Rgb:
    """Return a frame's colour [h, w, 3] with the sensor's faults; ``phase``: 0..1 along the sequence."""
    rng = np.random.default_rng([faults.seed, 1, index])
    out = rgb
    if faults.exposure_drift > 0:
        swing = float(np.sin(2.0 * np.pi * faults.exposure_swings * phase))
        out = exposed(out, 1.0 + faults.exposure_drift * swing)
    if faults.colour_noise > 0:
        out = noisy_colour(out, faults.colour_noise, rng)
    return out
