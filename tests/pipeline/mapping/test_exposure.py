# SPDX-License-Identifier: Apache-2.0
"""Keyframes' exposures: found at first sight, fitted with the map, kept apart from it."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.faults import SensorFaults
from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.exposure import estimate_exposure
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig
from ggwarp.types import Exposure, Frame, Rendered

OFFICE = SyntheticOffice(scale=0.1)
DARK = SyntheticOffice(scale=0.1, faults=SensorFaults(exposure_drift=0.4, exposure_swings=30.0))
"""Every second frame or so in another light."""
CONFIG = MapperConfig(exposure_rate=0.01)


def view_of(frame: Frame) -> Rendered:
    assert frame.depth is not None
    return Rendered(
        (frame.rgb / 255.0).astype(np.float32), frame.depth, frame.depth, np.ones_like(frame.depth)
    )


def with_exposure(frame: Frame, exposure: Exposure) -> Frame:
    exposed = np.exp(exposure.log_gain) * frame.rgb / 255.0 + exposure.offset
    return dataclasses.replace(frame, rgb=np.rint(255.0 * exposed.clip(0.0, 1.0)).astype(np.uint8))


def test_the_estimate_is_the_exposure_despite_what_changed() -> None:
    frame = OFFICE[0]
    true = Exposure((0.2, -0.1, 0.1), (0.03, 0.0, -0.02))
    seen = with_exposure(frame, true)
    seen.rgb[20:40, 30:60] = 120  # somebody walked in
    found = estimate_exposure(seen, view_of(frame), Exposure())
    np.testing.assert_allclose(found.log_gain, true.log_gain, atol=0.02)
    np.testing.assert_allclose(found.offset, true.offset, atol=0.01)


def test_a_map_that_shows_too_little_leaves_the_default() -> None:
    frame = OFFICE[0]
    view = view_of(frame)
    default = Exposure.uniform(0.3, 0.0)
    blank = dataclasses.replace(view, opacity=np.zeros_like(view.opacity))
    assert estimate_exposure(frame, blank, default) is default
    behind = dataclasses.replace(view, depth=2.0 * view.depth)
    assert estimate_exposure(frame, behind, default) is default


def made(device: str, frames: list[Frame], config: MapperConfig, *, recorded: bool = False) -> Mapper:
    mapper = build_mapper(config, OFFICE.camera, device=device, use_identity=False, recorded=recorded)
    for frame in frames:
        assert frame.T_wc is not None
        mapper.insert(frame, frame.T_wc)
        for _ in range(30):
            mapper.iterate()
    mapper.synchronise()
    return mapper


def error(mapper: Mapper, frame: Frame) -> float:
    assert frame.T_wc is not None
    return float(np.mean((mapper.render(frame.T_wc).rgb - frame.rgb / 255.0) ** 2))


def test_the_map_keeps_the_first_keyframes_light(device: str) -> None:
    frames = [OFFICE[0], DARK[1], OFFICE[2], DARK[3]]
    gains = [np.log(d.rgb.mean() / o.rgb.mean()) for d, o in ((DARK[i], OFFICE[i]) for i in (1, 3))]
    assert max(map(abs, gains)) > 0.2, "they differ"
    fitted, plain = made(device, frames, CONFIG), made(device, frames, MapperConfig())
    steady = made(device, [OFFICE[i] for i in range(4)], MapperConfig())
    true = [error(m, OFFICE[1]) for m in (steady, fitted, plain)]
    assert true[1] < 1.1 * true[0] < 0.5 * true[2], "as good as in one light"
    for number, gain in zip((1, 3), gains, strict=True):
        assert np.mean(fitted.keyframe_exposure(number).log_gain) == pytest.approx(gain, abs=0.06)
    assert fitted.keyframe_exposure(0) == Exposure()
    assert plain.keyframe_exposure(1) == Exposure()


def test_tracking_s_exposure_is_the_start(device: str) -> None:
    start = Exposure((0.1, 0.2, 0.3), (0.01, 0.02, 0.03))
    mapper = made(device, [OFFICE[0]], CONFIG)
    second = OFFICE[1]
    assert second.T_wc is not None
    mapper.insert(second, second.T_wc, start)
    np.testing.assert_allclose(mapper.keyframe_exposure(-1).log_gain, start.log_gain, rtol=1e-6)
    np.testing.assert_allclose(mapper.keyframe_exposure(-1).offset, start.offset, rtol=1e-6)


def test_recorded_and_direct_fits_are_the_same_to_the_bit(device: str) -> None:
    frames = [OFFICE[0], DARK[1]]
    direct, recorded = (made(device, frames, CONFIG, recorded=r) for r in (False, True))
    assert direct.keyframe_exposure(1) == recorded.keyframe_exposure(1) != Exposure()
    np.testing.assert_array_equal(direct.map.to_host().colours, recorded.map.to_host().colours)


def test_an_exposure_is_undone_for_every_level_of_every_channel(rng: np.random.Generator) -> None:
    exposure = Exposure((0.2, -0.1, 0.1), (0.03, 0.0, -0.02))
    rgb = rng.integers(0, 256, (7, 300, 3)).astype(np.uint8)
    expected = np.clip((rgb / 255.0 - exposure.offset) / np.exp(exposure.log_gain), 0.0, 1.0)
    for picture, colours in ((rgb, expected), (rgb[3], expected[3]), (rgb[:0], expected[:0])):
        found = exposure.undo_exposure(picture)
        assert found.dtype == np.float32 and found.shape == picture.shape
        np.testing.assert_allclose(found, colours, atol=1e-6)
