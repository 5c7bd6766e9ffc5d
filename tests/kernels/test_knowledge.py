# SPDX-License-Identifier: Apache-2.0
"""What a map knows of a view's objects, against NumPy; and every n-th pixel of planes."""

import cv2
import numpy as np
import pytest
import warp as wp

from ggwarp.kernels.identity.knowledge import LEVEL_BITS, NOTHING, KnowledgeLimits, tell_knowledge
from ggwarp.kernels.raster.thinning import thin_planes


def limits() -> KnowledgeLimits:
    out = KnowledgeLimits()
    out.tolerance, out.opacity, out.probability, out.known, out.certain = 0.03, 0.5, 0.7, 2, 3
    return out


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (17, 33)])
def test_knowledge_is_numpy_s(shape: tuple[int, int], device: str, rng: np.random.Generator) -> None:
    depth = np.where(rng.random(shape) < 0.2, 0.0, rng.uniform(1, 3, shape)).astype(np.float32)
    median = (depth * rng.choice([1.0, 1.02, 1.2], shape)).astype(np.float32)
    transmittance = rng.random(shape).astype(np.float32)
    classes = rng.integers(-1, 9, shape).astype(np.int32)
    probabilities = rng.random(shape).astype(np.float32)
    votes = (rng.integers(0, 5, shape) * (rng.random(shape) < 0.1)).astype(np.int32)
    for image in (depth, median, transmittance, probabilities):
        image[rng.random(shape) < 0.03] = np.nan

    with np.errstate(invalid="ignore"):
        shown = (depth > 0) & (np.abs(median - depth) <= np.float32(0.03) * depth)
        shown &= (np.float32(1) - transmittance > 0.5) & (classes >= 0)
        most = cv2.dilate(votes.astype(np.uint8), np.ones((3, 3), np.uint8)) if votes.size else votes
        level = np.where(probabilities >= np.float32(0.7), np.digitize(most, [2, 3]), 0)
    expected = np.where(shown, (classes << LEVEL_BITS) + level, int(NOTHING))

    out = wp.full(shape, 77, dtype=int, device=device)
    tell_knowledge(
        limits(),
        depth=wp.array(depth, dtype=float, device=device),
        median_depth=wp.array(median, dtype=float, device=device),
        transmittance=wp.array(transmittance, dtype=float, device=device),
        classes=wp.array(classes, dtype=int, device=device),
        probabilities=wp.array(probabilities, dtype=float, device=device),
        votes=wp.array(votes, dtype=int, device=device),
        out=out,
        device=device,
    )
    np.testing.assert_array_equal(out.numpy(), expected.reshape(shape))


@pytest.mark.parametrize("step", [1, 2, 4, 7])
def test_every_nth_pixel(step: int, device: str, rng: np.random.Generator) -> None:
    planes = rng.normal(size=(3, 26, 31)).astype(np.float32)
    few = planes[:, step // 2 :: step, step // 2 :: step]
    out = wp.full((3, few.shape[1] + 2, few.shape[2] + 1), 5.0, dtype=float, device=device)
    thin_planes(wp.array(planes, dtype=float, device=device), step=step, out=out, device=device)
    expected = np.zeros(out.shape, np.float32)
    expected[:, : few.shape[1], : few.shape[2]] = few
    np.testing.assert_array_equal(out.numpy(), expected)
