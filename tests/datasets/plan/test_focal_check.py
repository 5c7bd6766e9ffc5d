# SPDX-License-Identifier: Apache-2.0
"""A focal length that is far off is told by how the pictures move, and a right one is not doubted."""

import dataclasses
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp.datasets import open_dataset
from ggwarp.datasets.base import Dataset, at_scale
from ggwarp.datasets.plan.focal_check import FACTORS, errors, focal_doubt, pairs_around, view_of
from ggwarp.datasets.plan.sequence_plan import SAMPLES, plan_sequence
from ggwarp.geometry.camera import Camera
from ggwarp.types import Frame

COUNT = 26


@pytest.fixture(scope="module")
def office() -> Dataset:
    return at_scale(open_dataset("office", data_root=Path("absent")), 0.25)


@pytest.fixture(scope="module")
def frames(office: Dataset) -> list[Frame]:
    return [office[i] for i in range(COUNT)]


def longer(camera: Camera, factor: float) -> Camera:
    return dataclasses.replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


def doubt(frames: list[Frame], camera: Camera) -> str:
    pairs = pairs_around(np.linspace(0, len(frames) - 1, SAMPLES).astype(int).tolist(), len(frames))
    return focal_doubt({i: view_of(frame) for i, frame in enumerate(frames)}, pairs, camera)


def test_the_own_focal_length_leaves_the_least(office: Dataset, frames: list[Frame]) -> None:
    found = errors(view_of(frames[3]), view_of(frames[9]), office.camera)
    assert found is not None and FACTORS[int(found.argmin())] == 1.0 and found.min() < 0.5


@pytest.mark.parametrize("factor", [0.5, 0.63, 1.6, 2.0])
def test_another_one_is_named(office: Dataset, frames: list[Frame], factor: float) -> None:
    camera = longer(office.camera, factor)
    said = re.search(r"about (\d+) pixels, not ([\d.]+): is it", doubt(frames, camera))
    assert said is not None and float(said[2]) == pytest.approx(camera.fx, rel=1e-4)
    assert float(said[1]) == pytest.approx(office.camera.fx, rel=0.15)


def test_the_unit_of_depth_and_its_noise_do_not_matter(
    office: Dataset, frames: list[Frame], rng: np.random.Generator
) -> None:
    spoilt = []
    for frame in frames:
        assert frame.depth is not None
        noisy = 3.0 * frame.depth * (1.0 + 0.005 * rng.normal(size=frame.depth.shape))
        noisy[rng.random(noisy.shape) < 0.1] = 0.0
        spoilt.append(dataclasses.replace(frame, depth=noisy.astype(np.float32)))
    assert doubt(spoilt, office.camera) == ""
    assert doubt(spoilt, longer(office.camera, 2.0)).startswith("the pictures move as with a focal length")


def test_pictures_that_do_not_tell_say_nothing(office: Dataset, frames: list[Frame]) -> None:
    wrong = longer(office.camera, 2.0)
    assert doubt(frames[:1] * COUNT, wrong) == "", "it stands still"
    assert doubt(frames[:5], wrong) == "", "too few pairs"
    blank = [dataclasses.replace(frame, rgb=np.full_like(frame.rgb, 90)) for frame in frames]
    assert doubt(blank, wrong) == ""
    without = [dataclasses.replace(f, depth=np.zeros(f.rgb.shape[:2], np.float32)) for f in frames]
    assert doubt(without, wrong) == ""
    assert focal_doubt({}, pairs_around(range(10), 20), wrong) == ""


def test_pairs_lie_around_the_frames_and_inside() -> None:
    assert pairs_around([0, 10, 19], 20) == [(0, 3), (7, 13), (16, 19)]
    assert pairs_around([0], 1) == []


@pytest.mark.parametrize(
    "name",
    ["redkitchen", "livingroom1", "rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg3_teddy", "desk_loop"],
)
def test_recordings_are_as_they_say(recordings: Path, name: str) -> None:
    if not (recordings / name).is_dir():
        pytest.skip(f"{name} is not in {recordings}")
    dataset = open_dataset(name, data_root=recordings)
    looked_at = np.linspace(0, len(dataset) - 1, SAMPLES).astype(int).tolist()
    pairs = pairs_around(looked_at, len(dataset))
    views = {i: view_of(dataset[i]) for i in {i for pair in pairs for i in pair}}
    assert focal_doubt(views, pairs, dataset.camera) == ""
    if name != "desk_loop":  # its depth is half empty
        assert focal_doubt(views, pairs, longer(dataset.camera, 0.5))


def test_a_recording_with_another_lens_is_warned_of(
    tmp_path: Path, office: Dataset, frames: list[Frame]
) -> None:
    for name in ("color", "depth"):
        (tmp_path / name).mkdir()
    for i, frame in enumerate(frames):
        assert frame.depth is not None
        assert cv2.imwrite(str(tmp_path / f"color/{i}.png"), frame.rgb[..., ::-1])
        assert cv2.imwrite(str(tmp_path / f"depth/{i}.png"), np.rint(1e3 * frame.depth).astype(np.uint16))
    camera = office.camera
    values = {"w": camera.width, "h": camera.height, "cx": camera.cx, "cy": camera.cy, "scale": 1000}
    for factor in (1.0, 0.5):
        told = values | {"fx": factor * camera.fx, "fy": factor * camera.fy}
        (tmp_path / "camera.json").write_text(json.dumps(told))
        warnings = plan_sequence(open_dataset(str(tmp_path), data_root=tmp_path)).warnings
        assert any("with a focal length of about" in w for w in warnings) == (factor != 1.0), warnings
