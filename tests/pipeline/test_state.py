# SPDX-License-Identifier: Apache-2.0
"""A system that goes on from its state ends with the bits of one that was never stopped."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ggwarp.config import monocular, preset_config
from ggwarp.datasets import FrameReader, SyntheticOffice, WithoutDepth
from ggwarp.io.checkpoint import read_checkpoint, write_checkpoint
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.results.saved_run import SavedRun, load_run
from ggwarp.runtime.state import StateError
from ggwarp.types import Frame
from object_graph import differences

SCRATCH = {
    # What a frame or an iteration writes before it reads it.
    "Renderer.image",
    "Renderer.d_image",
    "Renderer.transmittance",
    "Renderer.median_depth",
    "Renderer.d_pose",
    "Renderer.splats",
    "Renderer.tiles",
    "Renderer.gradients",
    "Renderer.weights",
    "Renderer._slots",
    "Renderer._pose",
    "Renderer._sample",
    "Renderer._thinned",
    "Seeder._workspace",
    "GicpTracker._scratch",
    "_Ballot._scratch",
    "_Part.diameter",
    "Sample.phase",
    "GaussianOptimiser._workspace",
    "ExposureModel._workspace",
    "ExposureModel.image",
    "Covisibility._flags",
    "Classifier._d_weights",
    "Classifier._d_biases",
    "Classifier._workspace_3d",
    "Classifier._image_workspace",
    "Neighbourhood._queries",
    "Neighbourhood._distances2",
    "Neighbourhood._grid",
    "Neighbourhood.samples",
    "Neighbourhood.neighbours",
    "Registrar._arrays",
    "Aligner._rendered",
    "Aligner._observed",
    "Aligner._depth_noise",
    "Descent._folded",
    "Aligner._arrays",
    "Descent._pose_moments",
    "Descent._moments",
    "Descent._steps",
    "Descent._sums",
    "Descent._loss",
    # Of the frame that is being tracked.
    "GicpTracker._before",
    "GicpTracker.registration",
    "GicpTracker.information",
    "GicpTracker.predicted",
    "GicpTracker._seen",
    "FreeSpace._looked",
    # Made of the rest, when it is next asked for.
    "Submaps._balls",
    "Submaps._hidden",
    "Submaps._store",
    "Submaps._told",
    "GicpTracker._target",
    "LoopCloser._looked",
    "_Ballot._kept",
    "ReferenceViews._references",
    "ReferenceViews._points",
    "TrackableMap._snapshot",
    "Keyframes._packed_labels",
    "GaussianMap.allocation",
    "Renderer.allocation",
    "Matcher._flow",
}
"""Attributes that are no state. What is not here must be restored: name it in its class's ``STATE``."""


def changed(config: SlamConfig, **mapper: Any) -> SlamConfig:
    return dataclasses.replace(config, mapper=dataclasses.replace(config.mapper, **mapper))


def configurations() -> dict[str, SlamConfig]:
    default, monogs = (preset_config(name).slam for name in ("gg-slam", "monogs"))
    default = dataclasses.replace(default, tracker="gicp")
    with_3d = dataclasses.replace(default.mapper.classifier, weight_3d=1.0)
    densify = dataclasses.replace(monogs.mapper.densify, interval=20, reset_interval=23)
    window = dataclasses.replace(monogs.window, size=3, confirmations=1)
    often = dataclasses.replace(monogs.covisibility, interval=2)
    monogs = dataclasses.replace(monogs, covisibility=often)
    return {
        "gicp": changed(dataclasses.replace(default, tracker="gicp"), iterations=3, seed=5),
        "gicp, 3-D term": changed(default, iterations=3, classifier=with_3d),
        "hybrid": changed(dataclasses.replace(default, tracker="hybrid"), iterations=3),
        "untracked masks": changed(dataclasses.replace(default, masks_kind="untracked"), iterations=3),
        "photometric, exposure, densified": changed(
            dataclasses.replace(monogs, window=window),
            iterations=10,
            bootstrap=10,
            exposure_rate=0.01,
            densify=densify,
        ),
        "descent": changed(
            dataclasses.replace(monogs, refinement=dataclasses.replace(monogs.refinement, method="descent")),
            iterations=3,
            bootstrap=30,
        ),
        "monocular": changed(
            dataclasses.replace(monocular(default), covisibility=often), iterations=6, bootstrap=100
        ),
    }


@cache
def reader_of(mono: bool) -> FrameReader:
    office = SyntheticOffice()
    return FrameReader(WithoutDepth(office) if mono else office, range(0, 200), scale=0.1)


@cache
def frame_at(mono: bool, index: int) -> Frame:
    return reader_of(mono).read(index)


def system(config: SlamConfig, earlier: SavedRun | None = None) -> Slam:
    reader = reader_of(config.mono)
    return Slam(config, reader.camera, reader.sensor_camera, device="cpu", earlier=earlier)


def saved_and_restored(slam: Slam, path: Path) -> Slam:
    write_checkpoint(path, {"tracking": slam.tracking_state(), "mapping": slam.mapping_state()})
    tree = read_checkpoint(path)
    other = system(slam.config, slam.earlier)
    other.restore(tree["tracking"], tree["mapping"], lambda index: frame_at(slam.config.mono, index))
    return other


def frames_of(config: SlamConfig) -> list[Frame]:
    """Return frames that the tracker can follow, and that hold several keyframes."""
    if config.mono:  # the start, and a few frames more
        indices = range(100, 110)
    else:
        # A descent renders many times.
        few = config.refinement.method == "descent"
        indices = range(5 if few else 8) if config.tracker == "photometric" else range(0, 18, 3)
    return [frame_at(config.mono, i) for i in indices]


@pytest.mark.parametrize("name", list(configurations()))
def test_a_restored_system_is_the_same_and_goes_on_to_the_same_bits(name: str, tmp_path: Path) -> None:
    config = configurations()[name]
    frames = frames_of(config)
    # One camera alone: while it waits for parallax, too.
    moments = (3, 7) if config.mono else (len(frames) // 2,)
    compare(system(config), frames, moments, tmp_path)


def test_so_is_one_that_begins_in_an_earlier_map(tmp_path: Path) -> None:
    config = configurations()["hybrid"]
    first = system(config)
    for index in range(0, 18, 3):
        first.step(frame_at(False, index))
    first.save(tmp_path / "earlier")
    one = system(config, load_run(tmp_path / "earlier"))
    blank = dataclasses.replace(frame_at(False, 10), rgb=np.zeros_like(frame_at(False, 10).rgb))
    one.step(blank)
    assert one.localiser is not None and one.localiser.place is None and not one.keyframe_indices
    compare(one, [frame_at(False, index) for index in (11, 14, 17, 20)], (0, 2), tmp_path)
    assert one.localiser.place is not None


def compare(one: Slam, frames: list[Frame], moments: tuple[int, ...], tmp_path: Path) -> None:
    """Check that systems restored before the frames at ``moments`` go on as ``one`` does."""
    others: list[Slam] = []
    for number, frame in enumerate(frames):
        if number in moments:
            others.append(saved_and_restored(one, tmp_path / "c.safetensors"))
            assert list(differences(one, others[-1], SCRATCH)) == []
        for slam in (one, *others):
            slam.step(frame)
    assert one.map.count > 0 and len({*one.keyframe_indices}) > 1, "the test has something to compare"
    for other in others:
        for mine, theirs in zip(one.reports, other.reports, strict=True):
            np.testing.assert_array_equal(mine.T_wc, theirs.T_wc)
            assert mine.loss == theirs.loss or mine.loss != mine.loss
        rows = other.map_arrays().arrays()
        for field, values in one.map_arrays().arrays().items():
            np.testing.assert_array_equal(values, rows[field], err_msg=field)
        assert other.objects({}) == one.objects({})
        assert other.counts == one.counts and other.keyframe_indices == one.keyframe_indices


def test_a_forgotten_attribute_is_found(tmp_path: Path) -> None:
    config = configurations()["gicp"]
    one = system(config)
    for frame in frames_of(config)[:2]:
        one.step(frame)
    other = saved_and_restored(one, tmp_path / "c.safetensors")
    other._policy._since_tracking = 17  # pyright: ignore[reportAttributeAccessIssue]
    other._mapper._sampler._rng.random()  # pyright: ignore[reportAttributeAccessIssue]
    found = list(differences(one, other, SCRATCH))
    assert len(found) == 2 and "_since_tracking" in found[1] and "_rng" in found[0]


def test_another_recording_is_told(tmp_path: Path) -> None:
    config = configurations()["gicp"]
    slam = system(config)
    slam.step(frame_at(False, 0))
    with pytest.raises(StateError, match="frame 0 of the sequence is not the one that it was"):
        system(config).restore(slam.tracking_state(), slam.mapping_state(), lambda i: frame_at(False, i + 3))
