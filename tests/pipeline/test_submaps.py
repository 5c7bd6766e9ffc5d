# SPDX-License-Identifier: Apache-2.0
"""A walk through the apartment with a map that is larger than its memory, against one that has room."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ggwarp.config import preset_config
from ggwarp.datasets import FrameReader
from ggwarp.datasets.built_in.apartment import SyntheticApartment
from ggwarp.io.checkpoint import read_checkpoint, write_checkpoint
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.renderer import Renderer
from ggwarp.map.submap import MapBudget
from ggwarp.pipeline.slam import Slam
from ggwarp.results.saved_run import load_run
from ggwarp.types import Frame

WALK = SyntheticApartment(frames=150)
SMALL = MapBudget(4_000_000)
"""Two thousand Gaussians: less than a view has at most."""


@cache
def reader() -> FrameReader:
    return FrameReader(WALK, range(len(WALK)), scale=0.1)


@cache
def frame_at(index: int) -> Frame:
    return reader().read(index)


def system(budget: MapBudget | None) -> Slam:
    config = preset_config("fast").slam
    mapper = dataclasses.replace(config.mapper, iterations=8)
    config = dataclasses.replace(config, tracker="ground-truth", mapper=mapper)
    return Slam(config, reader().camera, reader().sensor_camera, device="cpu", map_budget=budget)


def walked(budget: MapBudget | None) -> Slam:
    slam = system(budget)
    for index in range(len(WALK)):
        slam.step(frame_at(index))
    slam.finish()
    return slam


def psnr(slam: Slam, index: int) -> float:
    frame = frame_at(index)
    assert frame.depth is not None and frame.T_wc is not None
    error = (slam.render(frame.T_wc).rgb - frame.rgb / 255.0)[frame.depth > 0.0]
    return -10.0 * np.log10(np.mean(error**2))


def assert_same_map(one: Slam, other: Slam) -> None:
    """Compare the Gaussians to the bit; their order goes by what is parked, which views change."""
    rows = [slam.map_arrays() for slam in (one, other)]
    rows = [gaussians.take(np.lexsort(gaussians.means.T)) for gaussians in rows]
    for name, values in rows[0].arrays().items():
        np.testing.assert_array_equal(values, getattr(rows[1], name), err_msg=name)


@pytest.fixture(scope="module")
def whole() -> Slam:
    return walked(None)


@pytest.fixture(scope="module")
def cut() -> Slam:
    return walked(SMALL)


def test_part_of_the_map_is_out_of_memory(whole: Slam, cut: Slam) -> None:
    submaps = cut._mapper.submaps
    assert len(submaps.parked) > 2 and cut.map.count < 0.7 * submaps.count
    assert whole._mapper.submaps.parked == [] and whole.map.count > 0.8 * submaps.count


def test_renders_are_no_worse(whole: Slam, cut: Slam) -> None:
    one, other = ([psnr(slam, index) for index in range(0, len(WALK), 3)] for slam in (whole, cut))
    assert np.mean(other) > np.mean(one) - 0.1


def test_each_keyframe_has_the_iterations_that_it_had(whole: Slam, cut: Slam) -> None:
    assert cut._mapper._optimiser.iterations == whole._mapper._optimiser.iterations == 8 * len(WALK)
    assert cut._mapper._sampler.put_off() == []


def test_a_view_is_that_of_the_map_in_one_piece(cut: Slam) -> None:
    whole = GaussianMap(device="cpu", has_identity=True)
    whole.append(dataclasses.replace(cut.map_arrays(), object_ids=None))
    renderer = Renderer(whole, cut.camera)
    errors = []
    for index in range(0, len(WALK), 10):
        frame = frame_at(index)
        assert frame.T_wc is not None and frame.depth is not None
        renderer.render(frame.T_wc)
        there = frame.depth > 0.0
        pictures = cut.render(frame.T_wc).rgb, renderer.picture().rgb
        errors.append([np.mean((rgb - frame.rgb / 255.0)[there] ** 2) for rgb in pictures])
    paged, one = -10.0 * np.log10(np.array(errors)).T
    assert np.abs(paged - one).max() < 0.1, "no seam"


def test_it_is_the_same_run_again(cut: Slam) -> None:
    assert_same_map(cut, walked(SMALL))


def test_results_have_the_whole_map(whole: Slam, cut: Slam, tmp_path: Path) -> None:
    cut.save(tmp_path / "run", {4: "sofa"})
    run = load_run(tmp_path / "run")
    assert len(run.gaussians) == cut._mapper.submaps.count > 1.5 * cut.map.count
    np.testing.assert_array_equal(run.gaussians.object_ids, cut.map_arrays().object_ids)
    found, expected = ({r.id: r for r in slam.objects({})} for slam in (cut, whole))
    assert len(found.keys() & expected.keys()) > 0.8 * len(expected)
    assert {r.id for r in run.objects} == found.keys()


def test_a_restored_system_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    slam = system(SMALL)
    for index in range(70):
        slam.step(frame_at(index))
    assert slam._mapper.submaps.parked and slam._mapper._optimiser.iterations < 8 * 70
    path = tmp_path / "c.safetensors"
    write_checkpoint(path, {"tracking": slam.tracking_state(), "mapping": slam.mapping_state()})
    tree = read_checkpoint(path)
    others = [system(SMALL), system(None)]
    for other in others:
        other.restore(tree["tracking"], tree["mapping"], frame_at)
    assert others[1]._mapper.submaps.parked == []
    assert others[1].map.count == slam._mapper.submaps.count
    for each in (slam, others[0]):
        for index in range(70, 80):
            each.step(frame_at(index))
        for _ in range(60):
            each.refine()
        each.finish()
    assert_same_map(slam, others[0])
    assert slam.objects({}) == others[0].objects({})
