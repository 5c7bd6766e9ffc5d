# SPDX-License-Identifier: Apache-2.0
"""Gaussians that are densified where the loss pulls at them, and opacities that begin anew."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.kernels.optim.adam import OPACITY_LANE
from ggwarp.map.gaussian_map import PARAMETERS, GaussianMap
from ggwarp.map.gaussians import Gaussians
from ggwarp.pipeline.mapping import densification
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.densification import DensifyConfig, densify_gaussians, lower_opacities
from ggwarp.pipeline.mapping.mapper import MapperConfig

THRESHOLD = 0.5


def made(device: str, rng: np.random.Generator, count: int) -> GaussianMap:
    gaussians = GaussianMap(device=device, has_identity=True, capacity=8)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    gaussians.append(
        Gaussians(
            means=rng.normal(size=(count, 3)).astype(np.float32),
            quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            log_scales=np.log(np.tile(np.float32([[0.05, 0.02, 0.01]]), (count, 1))),
            opacity_logits=rng.normal(size=count).astype(np.float32),
            colours=rng.normal(size=(count, 3)).astype(np.float32),
            identities=rng.normal(size=(count, 16)).astype(np.float32),
            keyframe_ids=np.arange(count, dtype=np.int32),
            votes=10 + np.arange(count, dtype=np.int32),
        )
    )
    return gaussians


def assign(gaussians: GaussianMap, name: str, values: np.ndarray) -> None:
    whole = gaussians.fields[name].numpy().copy()
    whole[: len(values)] = values
    gaussians.fields[name].assign(whole)


def test_small_ones_are_doubled_and_large_ones_split(
    device: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(densification, "_SPLIT_SCALE", 0.1)
    gaussians = made(device, rng, 5)
    large = gaussians.to_host().log_scales
    large[3] = np.log([0.3, 1e-6, 1e-6])
    assign(gaussians, "log_scales", large)
    # In the mean: 0.4, 0.6, none seen, 0.6, 0.5.
    assign(gaussians, "mean2d_gradient_norms", np.float32([4.0, 6.0, 0.0, 1.2, 0.5]))
    assign(gaussians, "mean2d_gradient_counts", np.int32([10, 10, 0, 2, 1]))
    before = gaussians.to_host().arrays()

    assert densify_gaussians(gaussians, rng, threshold=THRESHOLD) == 2

    after = gaussians.to_host().arrays()
    assert gaussians.count == 5 + 1 + 1
    keyframe_ids = gaussians.fields["keyframe_ids"].numpy()[:7].tolist()
    assert keyframe_ids == [0, 1, 2, 4, 1, 3, 3]
    np.testing.assert_array_equal(gaussians.fields["votes"].numpy()[:7], 10 + np.array(keyframe_ids))
    for name in PARAMETERS:
        values = after[name]
        np.testing.assert_array_equal(values[:5], before[name][[0, 1, 2, 4, 1]], err_msg=name)
        if name not in ("means", "log_scales"):
            np.testing.assert_array_equal(values[5:], before[name][[3, 3]], err_msg=name)
    np.testing.assert_allclose(after["log_scales"][5:], before["log_scales"][[3, 3]] - np.log(1.6), rtol=1e-5)
    # The parts lie along the long axis.
    axis = se3.matrix_from_quat(before["quats"][3])[:, 0]
    moved = after["means"][5:] - before["means"][3]
    np.testing.assert_allclose(moved, (moved @ axis)[:, None] * axis, atol=1e-4)
    assert 0.0 < np.abs(moved).max() < 1.5 and not np.allclose(moved[0], moved[1])
    assert (
        not gaussians.fields["mean2d_gradient_norms"].numpy().any()
        and not gaussians.fields["mean2d_gradient_counts"].numpy().any()
    )


@pytest.mark.parametrize("count", [0, 1, 20])
def test_without_gradients_nothing_changes(count: int, device: str, rng: np.random.Generator) -> None:
    gaussians = made(device, rng, count)
    version = gaussians.version
    assert densify_gaussians(gaussians, rng, threshold=THRESHOLD) == 0 and gaussians.version == version
    assign(gaussians, "mean2d_gradient_norms", np.full(count, np.nan, np.float32))
    assert densify_gaussians(gaussians, rng, threshold=THRESHOLD) == 0, "NaN pulls at nothing"


def test_unseen_opacities_are_lowered_and_forget_their_moments(device: str, rng: np.random.Generator) -> None:
    gaussians = made(device, rng, 4)
    assign(gaussians, "opacity_logits", np.float32([3.0, 3.0, -3.0, 3.0]))
    for name in ("first", "second"):
        assign(gaussians, name, np.ones((4, 16), np.float32))

    lower_opacities(gaussians, np.array([True, False, False, False]), 0.4)

    logit = np.log(0.4 / 0.6)
    np.testing.assert_allclose(gaussians.to_host().opacity_logits, [3.0, logit, -3.0, logit], rtol=1e-6)
    for name in ("first", "second"):
        moments = gaussians.fields[name].numpy()[:4]
        assert moments[:, OPACITY_LANE].tolist() == [1.0, 0.0, 1.0, 0.0]
        assert (np.delete(moments, OPACITY_LANE, axis=1) == 1.0).all()


def test_a_mapper_densifies_what_it_cannot_fit(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(densification, "_OFFSET", 5)
    monkeypatch.setattr(densification, "_SPLIT_SCALE", 0.05)
    office = SyntheticOffice(scale=0.1)
    frame = office[0]
    assert frame.T_wc is not None
    maps: list[dict[str, np.ndarray]] = []
    for interval in (0, 10, 10):
        densify = DensifyConfig(interval=interval, threshold=1e-4)
        config = MapperConfig(densify=densify)
        mapper = build_mapper(config, office.camera, device=device, use_identity=False)
        mapper.insert(frame, frame.T_wc)
        for _ in range(30):
            mapper.iterate()
        maps.append(mapper.map.to_host().arrays())
    without, first, second = maps
    assert 1.02 * len(without["means"]) < len(first["means"]) < 4 * len(without["means"])
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name], err_msg="twice the same")


def test_a_mapper_resets_what_its_newest_keyframe_does_not_see(device: str) -> None:
    office = SyntheticOffice(scale=0.1)
    config = MapperConfig(densify=DensifyConfig(reset_interval=4))
    mapper = build_mapper(config, office.camera, device=device, use_identity=False)
    for index in (0, 60):
        frame = dataclasses.replace(office[index], index=index)
        assert frame.T_wc is not None
        mapper.insert(frame, frame.T_wc)
    logits = np.full(mapper.map.count, 5.0, np.float32)
    assign(mapper.map, "opacity_logits", logits)
    for _ in range(3):
        mapper.iterate()
    assert (mapper.map.to_host().opacity_logits > 2.0).all()
    mapper.iterate()
    low = mapper.map.to_host().opacity_logits < 0.0
    assert 0.2 < low.mean() < 0.9
    wp.synchronize_device(device)
