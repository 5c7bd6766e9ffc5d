# SPDX-License-Identifier: Apache-2.0
"""Data sets as they are distributed: each is opened, and its truth agrees with its pictures."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from distributed_data_sets import (
    LAYOUTS,
    bonn,
    bundle_fusion,
    colmap,
    nerfstudio,
    scannet,
    scannetpp,
    sens,
    seven_scenes,
    table,
)
from ggwarp.datasets import DatasetError, FrameError, open_dataset
from ggwarp.datasets.source import source_of
from ggwarp.geometry.camera import Camera
from phone_recordings import FRAMES, opened, write
from recorded_scene import COLOUR, check_truth, look, pose


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_is_opened_and_its_truth_agrees(tmp_path: Path, name: str) -> None:
    LAYOUTS[name](tmp_path)
    dataset = opened(tmp_path)
    assert name.startswith(dataset.kind)
    assert len(dataset) == FRAMES and dataset.has_depth
    check_truth(dataset, colour=25.0 if "scannetpp" in name else 12.0)


def test_bonn_whose_truth_is_of_markers(tmp_path: Path) -> None:
    bonn(tmp_path / "rgbd_bonn_static")
    dataset = opened(tmp_path / "rgbd_bonn_static")
    assert dataset.camera.fx == 542.822841
    check_truth(dataset)


def test_one_camera_file_of_nonsense_spoils_one_frame(tmp_path: Path) -> None:
    LAYOUTS["arkitscenes"](tmp_path)
    first = min((tmp_path / "lowres_wide_intrinsics").glob("*.pincam"))
    first.write_text("1e30 60 50 50 40 30")
    dataset = opened(tmp_path)
    assert dataset.camera.width == COLOUR.width and dataset[1].rgb.any()
    with pytest.raises(FrameError, match="80x60, but the camera file says"):
        _ = dataset[0]
    for file in (tmp_path / "lowres_wide_intrinsics").glob("*.pincam"):
        file.write_text("1e30 60 50 50 40 30")
    with pytest.raises(DatasetError, match="its camera cannot be right: w is 1e"):
        opened(tmp_path)


def test_replica_with_its_own_instances(tmp_path: Path) -> None:
    LAYOUTS["replica-semantic"](tmp_path)
    dataset = opened(tmp_path)
    frame = dataset[1]
    assert dataset.has_masks and frame.mask is not None
    depth = look(Camera(80, 60, 40.0, 40.0, 39.5, 29.5), pose(1))[1]
    np.testing.assert_array_equal(frame.mask, np.where(depth < 1.9, 7, 0))
    without = open_dataset(str(tmp_path), data_root=tmp_path, masks="none")
    assert not without.has_masks
    assert source_of(dataset).unread == ()


def test_co_fusion_with_its_own_objects(tmp_path: Path) -> None:
    LAYOUTS["co-fusion"](tmp_path)
    dataset = opened(tmp_path)
    frame, depth = dataset[1], look(COLOUR, pose(1))[1]
    assert frame.mask is not None and frame.depth is not None
    np.testing.assert_array_equal(frame.mask, np.where(depth < 1.9, 2, 0))
    np.testing.assert_allclose(frame.depth.ravel()[1:], depth.ravel()[1:] + 0.003, atol=1e-5)
    assert frame.depth[0, 0] == 0.0 and frame.timestamp == 2 / 30
    source = source_of(dataset)
    assert source.unread == ("depth_original/ (3 .exr)", "mask_colour/ (3 .png)") and not source.notes
    assert not open_dataset(str(tmp_path), data_root=tmp_path, masks="none").has_masks
    (tmp_path / "calibration.txt").write_text("360 360 320 240 640 480")
    with pytest.raises(DatasetError, match=r"is of images of 640x480, but these are 80x60; correct it"):
        opened(tmp_path)
    (tmp_path / "calibration.txt").write_text("360 360 320")
    with pytest.raises(DatasetError, match=r"calibration\.txt: expected one line, fx fy cx cy width height"):
        opened(tmp_path)


def test_sens(tmp_path: Path) -> None:
    path = sens(tmp_path / "scene0000_00.sens")
    dataset = opened(path)
    assert dataset.kind == "sens" and len(dataset) == FRAMES
    check_truth(dataset)
    raw = opened(sens(tmp_path / "raw.sens", packing=0))
    np.testing.assert_array_equal(raw[1].depth, dataset[1].depth)
    write(tmp_path / "cut.sens", path.read_bytes()[:-900])
    cut = opened(tmp_path / "cut.sens")
    assert len(cut) == FRAMES
    np.testing.assert_array_equal(cut[1].rgb, dataset[1].rgb)
    with pytest.raises(FrameError, match=r"cut\.sens: is truncated: frame 2 and all after it are missing"):
        _ = cut[2]
    for keep in (0, 3, 100, 400):
        write(tmp_path / "cut.sens", path.read_bytes()[:keep])
        with pytest.raises(DatasetError, match=r"cut\.sens: is truncated"):
            opened(tmp_path / "cut.sens")
    write(tmp_path / "cut.sens", b"\x07" + path.read_bytes()[1:])
    with pytest.raises(DatasetError, match=r"cut\.sens: is no \.sens file of version 4"):
        opened(tmp_path / "cut.sens")


def test_lost_poses_of_scannet_are_no_truth(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scannet(tmp_path)
    for i in (0, 2):
        write(tmp_path / f"pose/{i}.txt", table(np.full((4, 4), -np.inf)))
    dataset = opened(tmp_path)
    assert [dataset[i].T_wc is None for i in range(3)] == [True, False, True]
    assert sum("hold no pose" in record.getMessage() for record in caplog.records) == 1


def test_7_scenes_registers_its_depth(tmp_path: Path) -> None:
    seven_scenes(tmp_path)
    depth, want = opened(tmp_path)[0].depth, look(Camera(640, 480, 525.0, 525.0, 320.0, 240.0), pose(0))[1]
    assert depth is not None
    seen = depth > 0
    assert seen.mean() > 0.78 and np.median(np.abs(depth - want)[seen]) < 3e-3
    assert np.percentile(np.abs(depth - want)[seen], 98) < 0.02


def test_7_scenes_of_another_size_needs_a_camera(tmp_path: Path) -> None:
    bundle_fusion(tmp_path, info=False)
    with pytest.raises(
        DatasetError, match=r"its camera is not known; write a camera\.json there, or give --intrin"
    ):
        opened(tmp_path)
    given = (COLOUR.fx, COLOUR.fy, COLOUR.cx, COLOUR.cy)
    check_truth(open_dataset(str(tmp_path), data_root=tmp_path, intrinsics=given))


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "FOV"])
def test_lenses_of_colmap_that_are_not_read(tmp_path: Path, model: str) -> None:
    colmap(tmp_path, binary=False)
    count = {"OPENCV_FISHEYE": 8, "FOV": 5}[model]
    write(tmp_path / "sparse/cameras.txt", f"5 {model} 80 60 " + " ".join(["40"] * count))
    with pytest.raises(DatasetError, match=f"its lens, {model}, is not read; run COLMAP's image_undistorter"):
        opened(tmp_path)


def test_lenses_of_colmap_that_bend(tmp_path: Path) -> None:
    colmap(tmp_path, binary=False)
    write(tmp_path / "sparse/cameras.txt", f"5 SIMPLE_RADIAL 80 60 {COLOUR.fx} 40.5 30.5 0.05")
    dataset = opened(tmp_path)
    assert dataset.camera == Camera(80, 60, COLOUR.fx, COLOUR.fx, 40.0, 30.0)
    assert not np.array_equal(dataset[0].rgb, look(COLOUR, pose(0))[0])


@pytest.mark.parametrize("layout", ["nerfstudio", "colmap"])
def test_depth_of_a_pictures_own_pixels_is_straightened_with_it(tmp_path: Path, layout: str) -> None:
    K, lens = COLOUR.matrix, np.array([0.15, 0.0, 0.0, 0.0])
    grid = np.stack(np.meshgrid(np.arange(80.0), np.arange(60.0)), -1).astype(np.float32)
    maps = cv2.undistortPoints(grid.reshape(-1, 1, 2), K, lens, P=K).reshape(60, 80, 2)
    nerfstudio(tmp_path) if layout == "nerfstudio" else colmap(tmp_path, binary=False)
    for file in tmp_path.rglob("*.png"):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(str(file), cv2.remap(image, maps, None, cv2.INTER_NEAREST))
    if layout == "nerfstudio":
        values = json.loads((tmp_path / "transforms.json").read_text())
        write(tmp_path / "transforms.json", json.dumps(values | {"k1": 0.15}))
    else:
        p = [COLOUR.fx, COLOUR.fy, COLOUR.cx + 0.5, COLOUR.cy + 0.5, *lens]
        write(tmp_path / "sparse/cameras.txt", "5 OPENCV 80 60 " + " ".join(map(str, p)))
    frame, want = opened(tmp_path)[0], look(COLOUR, pose(0))
    assert frame.depth is not None
    seen = frame.depth > 0
    assert seen.mean() > 0.7 and np.mean(np.abs(frame.depth - want[1])[seen] < 0.03) > 0.9
    assert np.median(np.abs(frame.rgb.astype(float) - want[0])[seen]) < 8


def test_nerfstudio_refuses_fisheye_by_name(tmp_path: Path) -> None:
    nerfstudio(tmp_path)
    values = json.loads((tmp_path / "transforms.json").read_text())
    write(tmp_path / "transforms.json", json.dumps(values | {"camera_model": "OPENCV_FISHEYE"}))
    with pytest.raises(DatasetError, match="camera_model is 'OPENCV_FISHEYE'; read are OPENCV"):
        opened(tmp_path)


def test_depth_that_nerfstudios_file_does_not_name_is_told(tmp_path: Path) -> None:
    nerfstudio(tmp_path)
    values = json.loads((tmp_path / "transforms.json").read_text())
    for frame in values["frames"]:
        depth = tmp_path / frame.pop("depth_file_path")
        write(tmp_path / "depths" / depth.name, depth.read_bytes())
    write(tmp_path / "transforms.json", json.dumps(values))
    dataset = opened(tmp_path)
    assert not dataset.has_depth
    assert any("transforms.json names no depth; give each" in note for note in source_of(dataset).notes)


def test_depth_beside_colmaps_images_is_told(tmp_path: Path) -> None:
    colmap(tmp_path, binary=True)
    (tmp_path / "depth").rename(tmp_path / "depth_maps")
    dataset = opened(tmp_path)
    (note,) = source_of(dataset).notes
    assert not dataset.has_depth and "depth_maps/ (1 folder) is not read: depth is read from depth/" in note


def test_a_depth_stream_that_ends_early(tmp_path: Path) -> None:
    scannetpp(tmp_path, "stream")
    data = (tmp_path / "depth.bin").read_bytes()
    write(tmp_path / "depth.bin", data[: int(0.5 * len(data))])
    dataset = opened(tmp_path)
    want = dataset[0].depth
    with pytest.raises(FrameError, match=r"depth\.bin: frame 2 is damaged or missing"):
        _ = dataset[2]
    np.testing.assert_array_equal(dataset[0].depth, want)  # going back begins anew
