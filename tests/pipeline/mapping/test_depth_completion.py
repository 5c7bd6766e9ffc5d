# SPDX-License-Identifier: Apache-2.0
"""The depth of monocular keyframes: the map's, else the motion's, else a smooth guess."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry.two_views import filled
from ggwarp.pipeline.mapping.depth_completion import DepthCompletion
from ggwarp.types import Frame, Rendered

OFFICE = SyntheticOffice(scale=0.2)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [OFFICE[i] for i in range(6)]


def view(frame: Frame, share: float, wrong: float = 1.0) -> Rendered:
    """The left ``share`` of the true view, its depth off by a factor."""
    assert frame.depth is not None
    opacity = np.zeros_like(frame.depth)
    opacity[:, : round(share * frame.depth.shape[1])] = 1.0
    depth = opacity * frame.depth * np.float32(wrong)
    return Rendered((frame.rgb / 255.0).astype(np.float32), depth, depth, opacity)


def completion(frames: list[Frame]) -> DepthCompletion:
    out = DepthCompletion(OFFICE.camera)
    for frame in frames:
        assert frame.T_wc is not None
        out.observe(dataclasses.replace(frame, depth=None, T_wc=None), frame.T_wc)
    return out


def error(estimate: np.ndarray, frame: Frame) -> np.ndarray:
    assert frame.depth is not None
    return np.abs(estimate / frame.depth - 1.0)


def test_the_map_s_own_depth_where_there_is_a_map_and_the_motion_s_elsewhere(frames: list[Frame]) -> None:
    newest = frames[5]
    assert newest.T_wc is not None
    estimate = completion(frames[:5]).estimate(newest, newest.T_wc, view(newest, 0.5))
    half = estimate.shape[1] // 2
    off = error(estimate, newest)
    assert (estimate > 0.0).all()
    assert np.median(off[:, :half]) < 1e-6
    assert np.median(off[:, half:]) < 0.06


def test_motion_contradicts_a_wrong_map(frames: list[Frame]) -> None:
    newest = frames[5]
    assert newest.T_wc is not None
    wrong = view(newest, 1.0, wrong=1.6)
    alone = error(completion([]).estimate(newest, newest.T_wc, wrong), newest)
    np.testing.assert_allclose(np.median(alone), 0.6, atol=1e-6)
    moved = error(completion(frames[:5]).estimate(newest, newest.T_wc, wrong), newest)
    assert np.median(moved) < 0.1


def test_gaps_are_filled_from_around(rng: np.random.Generator) -> None:
    inverse = 0.2 + 0.002 * np.arange(120.0) + np.zeros((80, 1))
    depth = (1.0 / inverse).astype(np.float32)
    holed = np.where(rng.random(depth.shape) < 0.3, depth, 0.0).astype(np.float32)
    holed[30:50, 40:70] = 0.0
    whole = filled(holed)
    np.testing.assert_allclose(whole[holed > 0.0], depth[holed > 0.0], rtol=1e-6)
    assert np.abs(whole / depth - 1.0).max() < 0.15


def test_a_far_corner_gets_the_median_and_an_empty_image_nothing() -> None:
    lone = np.zeros((400, 400), np.float32)
    lone[0, 0] = 3.0
    assert np.allclose(filled(lone), 3.0)
    assert not filled(np.zeros((4, 5), np.float32)).any()
