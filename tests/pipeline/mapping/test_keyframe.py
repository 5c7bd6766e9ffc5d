# SPDX-License-Identifier: Apache-2.0
"""Keyframes on the device: what each reading of depth counts goes with it, and comes back with its frame."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.keyframe import KeyframeBuffer, Keyframes, upload
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.runtime.image_store import ImageStore
from ggwarp.types import Exposure, Float32, Frame

SHAPE = 6, 8


def frame(weight: Float32 | None) -> Frame:
    depth = np.full(SHAPE, 2.0, np.float32)
    return Frame(0, 0.0, np.zeros((*SHAPE, 3), np.uint8), depth, depth_weight=weight)


def weights(of: Frame, device: str) -> np.ndarray | None:
    array = upload(of, np.eye(4), None, device=device).depth_weights
    return None if array is None else array.numpy()


def test_a_variance_twice_as_large_counts_by_its_deviation(device: str) -> None:
    shares = np.ones(SHAPE, np.float32)
    shares[:3] = 0.5
    got = weights(frame(shares), device)
    assert got is not None and (got[3:] == 75).all() and (got[:3] == 53).all(), "in the mean one, which is 64"
    for alike in (None, np.full(SHAPE, 0.5, np.float32), np.zeros(SHAPE, np.float32)):
        assert weights(frame(alike), device) is None
    assert weights(dataclasses.replace(frame(shares), depth=None), device) is None


def test_weights_of_the_sensor_are_brought_to_the_map_s_size(device: str) -> None:
    native = np.ones((24, 32), np.float32)
    native[:, :16] = 0.25
    got = weights(frame(native), device)
    assert got is not None and got.shape == SHAPE
    assert (got[:, 4:] == 85).all() and (got[:, :4] == 43).all()


@pytest.mark.parametrize("budget", [None, 0])
def test_weights_are_kept_and_read_again_with_their_frame(device: str, budget: int | None) -> None:
    shares = np.linspace(0.1, 1.0, 48, dtype=np.float32).reshape(SHAPE)
    source = frame(shares)
    keyframes = Keyframes(ImageStore(device=device, budget=budget))
    for given in (source, frame(None), source):
        keyframes.append(upload(given, np.eye(4), None, device=device))
    assert keyframes[1].depth_weights is None
    want = weights(source, device)
    restored = Keyframes(ImageStore(device=device))
    restored.restore(keyframes.state(), lambda index: source)
    for kept in (keyframes[0], keyframes[2], restored[0]):
        assert kept.depth_weights is not None
        np.testing.assert_array_equal(kept.depth_weights.numpy(), want)
    buffer = KeyframeBuffer()
    assert buffer.load(keyframes[0]).depth_weights is not None
    assert buffer.load(keyframes[1]).depth_weights is None


def test_what_is_fitted_of_many_keyframes_stays_with_each(device: str) -> None:
    """Their rows move to larger arrays as they come; what is written to a keyframe is found there."""
    keyframes = Keyframes(ImageStore(device=device))
    given = upload(frame(None), np.eye(4), None, Exposure((0.1, 0.2, 0.3)), device=device)
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = np.arange(200)
    for number, T_wc in enumerate(poses):
        keyframes.append(given)
        keyframes.set_pose(number, T_wc)
        keyframes[number].pose_steps.fill_(number)
    for number in (0, 63, 64, 127, 128, 199, -1):
        np.testing.assert_allclose(keyframes.pose(number), poses[number], atol=1e-6)
        assert keyframes[number].pose_steps.numpy().tolist() == [number % 200]
        np.testing.assert_allclose(keyframes.exposure(number).log_gain, (0.1, 0.2, 0.3), rtol=1e-6)
    restored = Keyframes(ImageStore(device=device))
    restored.restore(keyframes.state(), lambda index: frame(None))
    np.testing.assert_array_equal(restored.state()["fitted"]["T_cw"], keyframes.state()["fitted"]["T_cw"])
    with pytest.raises(IndexError):
        keyframes.pose(200)


def test_readings_of_less_confidence_bind_the_map_less(device: str) -> None:
    """On the left two views disagree by 2 cm; the surface ends nearer to the one whose depth counts more."""
    office = SyntheticOffice(scale=0.1)
    frame = office[0]
    assert frame.T_wc is not None and frame.depth is not None
    left = np.arange(frame.depth.shape[1]) < frame.depth.shape[1] // 2
    moved = np.where(left & (frame.depth > 0.0), frame.depth + np.float32(0.02), frame.depth)
    found = []
    for weight in (None, 0.1):
        mapper = build_mapper(MapperConfig(), office.camera, device=device, use_identity=False)
        shares = None if weight is None else np.where(left, weight, np.ones_like(moved)).astype(np.float32)
        mapper.insert(frame, frame.T_wc)
        mapper.insert(dataclasses.replace(frame, index=1, depth=moved, depth_weight=shares), frame.T_wc)
        for _ in range(150):
            mapper.iterate()
        rendered = mapper.render(frame.T_wc)
        seen = left & (rendered.opacity > 0.9) & (frame.depth > 0.0)
        found.append(float(np.median((rendered.surface_depth - frame.depth)[seen])))
    assert found[1] < 0.6 * found[0]
