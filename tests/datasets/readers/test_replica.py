# SPDX-License-Identifier: Apache-2.0
"""Scenes in the Replica layout: both spellings, poses, and every mistake."""

import json
import logging
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ggwarp.datasets import DatasetError, FrameError, open_dataset
from ggwarp.datasets.readers.replica import open_sequence
from ggwarp.geometry import se3

Maker = Callable[..., Path]


@pytest.mark.parametrize("spelling", ["results", "images"])
def test_frames_of_both_spellings(make_replica: Maker, sample: SimpleNamespace, spelling: str) -> None:
    dataset = open_sequence(make_replica(3, spelling=spelling))
    assert len(dataset) == 3 and dataset.has_depth and not dataset.has_masks
    frame = dataset[2]
    assert frame.index == 2 and frame.timestamp == pytest.approx(2 / 30)
    np.testing.assert_array_equal(frame.rgb, sample.colour(2)[..., ::-1])
    assert frame.depth is not None and frame.depth.dtype == np.float32
    assert frame.depth[0, 0] == 0.0 and frame.depth[5, 5] == np.float32(1.002)
    assert frame.T_wc is not None and frame.mask is None and frame.sensor_depth is None
    np.testing.assert_allclose(frame.T_wc, sample.pose(2), atol=1e-9)


def test_frames_are_ordered_by_number_not_by_text(make_replica: Maker, sample: SimpleNamespace) -> None:
    scene = make_replica(0, poses=False)
    for i in (2, 10, 9):
        sample.save(scene / "results" / f"frame{i}.png", sample.colour(i))
        sample.save(scene / "results" / f"depth{i}.png", sample.depth(i))
    dataset = open_sequence(scene)
    assert [int(dataset[i].rgb[0, 0, 2]) for i in range(3)] == [2, 9, 10]


def test_the_camera_file_of_the_scene_goes_before_the_one_above(make_replica: Maker) -> None:
    scene = make_replica(1)
    flat = json.loads((scene.parent / "cam_params.json").read_text())["camera"]
    (scene / "cam_params.json").write_text(json.dumps({**flat, "fx": 33.0, "scale": 500.0}))
    dataset = open_sequence(scene)
    assert dataset.camera.fx == 33.0
    depth = dataset[0].depth
    assert depth is not None and depth[5, 5] == 2.0


def test_without_truth_a_scene_runs(make_replica: Maker) -> None:
    dataset = open_sequence(make_replica(2, poses=False))
    assert [dataset[i].T_wc for i in range(2)] == [None, None]


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_a_row_that_is_not_finite_is_no_pose(
    make_replica: Maker, caplog: pytest.LogCaptureFixture, value: str
) -> None:
    scene = make_replica(3)
    rows = (scene / "traj.txt").read_text().splitlines()
    rows[1] = " ".join([value, *rows[1].split()[1:]])
    (scene / "traj.txt").write_text("\n".join(rows))
    dataset = open_sequence(scene)
    assert [dataset[i].T_wc is None for i in range(3)] == [False, True, False]
    assert len(caplog.records) == 1 and "line 2" in caplog.text and "traj.txt" in caplog.text


def test_a_row_that_is_no_rigid_motion_is_no_pose(make_replica: Maker, sample: SimpleNamespace) -> None:
    scene = make_replica(3)
    mirrored = np.diag([1.0, 1.0, -1.0, 1.0])
    rows = [sample.matrix_row(T) for T in (np.eye(4), np.zeros((4, 4)), mirrored)]
    (scene / "traj.txt").write_text("\n".join(rows))
    dataset = open_sequence(scene)
    assert [dataset[i].T_wc is None for i in range(3)] == [False, True, True]


def test_deleted_images_keep_the_other_images_poses(
    make_replica: Maker, sample: SimpleNamespace, caplog: pytest.LogCaptureFixture
) -> None:
    scene = make_replica(4)
    (scene / "results/frame000001.png").unlink()
    dataset = open_sequence(scene)
    T_wc = dataset[1].T_wc
    assert T_wc is not None and "4 poses for 3 images" in caplog.text
    np.testing.assert_allclose(T_wc, sample.pose(2), atol=1e-9)


def test_rows_of_three_by_four_are_poses(make_replica: Maker, sample: SimpleNamespace) -> None:
    scene = make_replica(1)
    (scene / "traj.txt").write_text(sample.matrix_row(sample.pose(5)[:3]))
    T_wc = open_sequence(scene)[0].T_wc
    np.testing.assert_allclose(T_wc, sample.pose(5), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 one", r"traj\.txt:2: 'one' is not a number"),
        ("1 0 0", r"traj\.txt:2: 3 numbers"),
    ],
)
def test_malformed_poses_are_named(make_replica: Maker, text: str, says: str) -> None:
    scene = make_replica(2)
    first = (scene / "traj.txt").read_text().splitlines()[0]
    (scene / "traj.txt").write_text(f"{first}\n{text}\n")
    with pytest.raises(DatasetError, match=says):
        open_sequence(scene)


def test_an_empty_scene(make_replica: Maker) -> None:
    scene = make_replica(0, poses=False)
    (scene / "results").mkdir()
    with pytest.raises(DatasetError, match="the sequence is empty"):
        open_sequence(scene)


def test_no_camera_file(make_replica: Maker) -> None:
    scene = make_replica(1)
    (scene.parent / "cam_params.json").unlink()
    with pytest.raises(DatasetError, match=r"cam_params\.json: no camera file in .*scene or .*Replica"):
        open_sequence(scene)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": -600}, "fx is -600; it must be positive"),
        ({"fx": "600"}, "fx is '600'; it must be a finite number"),
        ({"cy": float("nan")}, "cy is nan"),
        ({"h": 16.5}, "height is 16.5; it must be a whole number"),
        ({"scale": 0}, "depth_scale is 0; it must be positive"),
        ({"fx": None}, "fx is None"),
        ({"distortion": [1, 2]}, "distortion is"),
    ],
)
def test_a_camera_file_with_a_bad_value(make_replica: Maker, change: dict[str, object], says: str) -> None:
    scene = make_replica(1)
    path = scene.parent / "cam_params.json"
    path.write_text(json.dumps({"camera": {**json.loads(path.read_text())["camera"], **change}}))
    with pytest.raises(DatasetError, match=says) as error:
        open_sequence(scene)
    assert "cam_params.json" in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", r"cam_params\.json:1: is not JSON"),
        ("[1, 2]", "is not a JSON object"),
        ("{}", "fx is missing"),
    ],
)
def test_a_malformed_camera_file(make_replica: Maker, text: str, says: str) -> None:
    scene = make_replica(1)
    (scene.parent / "cam_params.json").write_text(text)
    with pytest.raises(DatasetError, match=says):
        open_sequence(scene)


def test_a_camera_file_of_another_size_fails_at_once(make_replica: Maker) -> None:
    scene = make_replica(3)
    path = scene.parent / "cam_params.json"
    path.write_text(path.read_text().replace('"w": 24', '"w": 1200'))
    with pytest.raises(DatasetError, match=r"frame000000\.png: 24x16, but the camera file says 1200x16"):
        open_sequence(scene)


def test_one_wrong_sized_image_spoils_one_frame(make_replica: Maker, sample: SimpleNamespace) -> None:
    scene = make_replica(3)
    sample.save(scene / "results/frame000001.png", sample.colour(1, 20, 10))
    dataset = open_sequence(scene)
    with pytest.raises(FrameError, match=r"frame000001\.png: 20x10, but the camera file says 24x16"):
        dataset[1]
    assert dataset[2].index == 2


def test_a_wrong_sized_depth_names_both_sizes_and_the_remedy(
    make_replica: Maker, sample: SimpleNamespace
) -> None:
    scene = make_replica(3)
    sample.save(scene / "results/depth000001.png", sample.depth(1, 12, 9))
    with pytest.raises(FrameError, match=r"depth000001\.png: 12x9, but the colour is 24x16; export"):
        open_sequence(scene)[1]


def test_a_missing_depth_spoils_one_frame(make_replica: Maker) -> None:
    scene = make_replica(3)
    (scene / "results/depth000001.png").unlink()
    dataset = open_sequence(scene)
    with pytest.raises(FrameError, match=r"frame000001\.png: there is no depth image"):
        dataset[1]


def test_an_index_outside_is_an_index_error(make_replica: Maker) -> None:
    dataset = open_sequence(make_replica(2))
    for index in (-1, 2):
        with pytest.raises(IndexError):
            dataset[index]


@pytest.mark.parametrize(
    ("name", "count", "size"), [("office0_kf", 40, (1200, 680)), ("redkitchen", 200, (640, 480))]
)
def test_real_recordings(
    recordings: Path, caplog: pytest.LogCaptureFixture, name: str, count: int, size: tuple[int, int]
) -> None:
    with caplog.at_level(logging.WARNING):
        dataset = open_dataset(name, data_root=recordings)
    assert len(dataset) == count and not caplog.records
    frame = dataset[count - 1]
    assert frame.rgb.shape == (size[1], size[0], 3) and frame.depth is not None and frame.T_wc is not None
    valid = frame.depth[frame.depth > 0]
    assert 0.3 < valid.min() and valid.max() < 10.0
    np.testing.assert_allclose(se3.orthonormalised(frame.T_wc), frame.T_wc, atol=1e-5)


def test_another_programs_results_beside_a_recording(make_folder: Maker) -> None:
    folder = make_folder(2)
    (folder / "results").mkdir()
    (folder / "results/stats.json").touch()
    dataset = open_dataset(str(folder), data_root=folder)
    assert dataset.kind == "folder" and len(dataset) == 2
