# SPDX-License-Identifier: Apache-2.0
"""Recordings of phones' apps: what each writes is opened, and its truth agrees with its pictures."""

import zipfile
from pathlib import Path

import lzfse
import numpy as np
import pytest

from ggwarp.datasets import DatasetError, FrameError
from phone_recordings import FRAMES, opened, r3d, record3d_export, stray, write
from recorded_scene import COLOUR, check_truth


@pytest.mark.parametrize("own_cameras", [False, True])
def test_stray_scanner(tmp_path: Path, own_cameras: bool) -> None:
    dataset = opened(stray(tmp_path / "scan", own_cameras=own_cameras))
    assert dataset.kind == "stray" and len(dataset) == FRAMES
    check_truth(dataset, colour=25.0)  # a video's colours
    depth = dataset[2].depth
    assert depth is not None and (depth[:6] == 0).all(), "low confidence is left out"
    assert (depth[12:] > 0).all()
    weight = dataset[2].depth_weight
    assert weight is not None and weight.shape == depth.shape
    assert (weight[10:22] == 0.5).all() and (weight[26:] == 1.0).all(), "medium confidence counts half"
    assert dataset[0].rgb.shape == dataset[2].rgb.shape


def test_stray_scanner_without_a_part(tmp_path: Path) -> None:
    path = stray(tmp_path / "scan")
    (path / "odometry.csv").rename(tmp_path / "odometry.csv")
    with pytest.raises(DatasetError, match=r"odometry\.csv: is missing; copy the whole folder"):
        opened(path)
    write(path / "odometry.csv", "0.0, 0, 1, 2, 3, 0, 0, 0, 1")
    with pytest.raises(DatasetError, match=r"odometry\.csv:1: expected the names of columns"):
        opened(path)
    write(path / "odometry.csv", "timestamp, frame, x, y, z\n0.0, 7, 1, 2, 3")
    with pytest.raises(DatasetError, match=r"odometry\.csv: has no column qx"):
        opened(path)


def test_record3d_archive(tmp_path: Path) -> None:
    dataset = opened(r3d(tmp_path / "scan.r3d"))
    assert dataset.kind == "record3d" and len(dataset) == FRAMES
    check_truth(dataset)
    depth = dataset[1].depth
    assert depth is not None and (depth[-10:] == 0).all() and (depth[5:40] > 0).all()
    with zipfile.ZipFile(tmp_path / "scan.r3d") as archive:
        archive.extractall(tmp_path / "apart")
    apart = opened(tmp_path / "apart")
    np.testing.assert_array_equal(apart[1].rgb, dataset[1].rgb)
    own = [[COLOUR.fx * 1.1, COLOUR.fy * 1.1, COLOUR.cx, COLOUR.cy]] + [
        [COLOUR.fx, COLOUR.fy, COLOUR.cx, COLOUR.cy]
    ] * (FRAMES - 1)
    told = opened(r3d(tmp_path / "own.r3d", perFrameIntrinsicCoeffs=own))
    assert told.camera.fx == pytest.approx(COLOUR.fx)
    assert not np.array_equal(told[0].rgb, dataset[0].rgb)
    np.testing.assert_array_equal(told[1].rgb, dataset[1].rgb)


def test_record3d_export(tmp_path: Path) -> None:
    record3d_export(tmp_path)
    dataset = opened(tmp_path)
    check_truth(dataset)
    assert dataset[2].timestamp == 0.7


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": [1, 2]}, "K is not nine numbers"),
        ({"K": None}, "has no K"),
        ({"K": [float("nan")] * 9}, "K is not nine numbers"),
        ({"K": [900.0, 0, 0, 0, 900.0, 0, 1e9, 5, 1]}, "its camera cannot be right"),
    ],
)
def test_record3d_metadata_that_cannot_be(tmp_path: Path, change: dict, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        opened(r3d(tmp_path / "scan.r3d", **change))


def test_a_damaged_r3d_is_refused(tmp_path: Path) -> None:
    path = r3d(tmp_path / "scan.r3d")
    data = path.read_bytes()
    write(tmp_path / "cut.r3d", data[: len(data) // 2])
    with pytest.raises(DatasetError, match=r"cut\.r3d: is no archive that can be read"):
        opened(tmp_path / "cut.r3d")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "apart")
    for name, content in (("1.depth", b"bvxn" + bytes(40)), ("2.depth", lzfse.compress(bytes(17)))):
        write(tmp_path / "apart/rgbd" / name, content)
    dataset = opened(tmp_path / "apart")
    for i in (1, 2):
        with pytest.raises(FrameError, match=rf"{i}\.depth: (is not compressed|has 17 bytes)"):
            _ = dataset[i]
