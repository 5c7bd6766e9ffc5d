# SPDX-License-Identifier: Apache-2.0
"""Video files and plain folders of images: recordings whose camera only the user knows."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ggwarp.datasets import Dataset, DatasetError, FrameReader, open_dataset
from ggwarp.geometry.camera import Camera
from ggwarp.types import Frame

INTRINSICS = (50.0, 51.0, 31.5, 23.5)


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Eight grey frames, each brighter than the one before."""
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    assert writer.isOpened()
    for i in range(8):
        writer.write(np.full((48, 64, 3), 20 + 25 * i, np.uint8))
    writer.release()
    return path


def test_a_video_is_a_sequence_without_depth(film: Path, tmp_path: Path) -> None:
    dataset = open_dataset(str(film), data_root=tmp_path, intrinsics=INTRINSICS)
    assert isinstance(dataset, Dataset)
    assert (dataset.name, dataset.kind, len(dataset)) == ("walk", "video", 8)
    assert not dataset.has_depth and not dataset.has_masks
    assert dataset.camera == Camera(64, 48, *INTRINSICS)
    for index in (0, 1, 5, 2, 7):  # on, ahead, back
        frame = dataset[index]
        assert frame.index == index and frame.timestamp == pytest.approx(index / 20.0)
        assert abs(float(frame.rgb.mean()) - (20 + 25 * index)) < 3.0
        assert frame.depth is None and frame.T_wc is None
    with pytest.raises(IndexError):
        dataset[8]


def test_a_video_is_read_at_any_scale(film: Path, tmp_path: Path) -> None:
    dataset = open_dataset(str(film), data_root=tmp_path, intrinsics=INTRINSICS)
    with FrameReader(dataset, range(2, 5), scale=0.5) as reader:
        frames = list(reader)
    assert all(isinstance(f, Frame) and f.rgb.shape == (24, 32, 3) and f.depth is None for f in frames)


def test_a_broken_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "walk.mp4").write_bytes(b"no film at all")
    with pytest.raises(DatasetError, match=r"walk\.mp4: is not a video"):
        open_dataset(str(tmp_path / "walk.mp4"), data_root=tmp_path, intrinsics=INTRINSICS)


def test_an_unknown_camera_ends_in_what_to_give(film: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"give --intrinsics FX FY CX CY.*64x48.*51 51 31\.5 23\.5"):
        open_dataset(str(film), data_root=tmp_path)


@pytest.mark.parametrize(
    ("intrinsics", "message"),
    [((0.0, 50.0, 31.5, 23.5), "positive"), ((50.0, 50.0, 640.0, 23.5), "outside the 64x48")],
)
def test_wrong_intrinsics_are_refused(
    film: Path, tmp_path: Path, intrinsics: tuple[float, float, float, float], message: str
) -> None:
    with pytest.raises(DatasetError, match=message):
        open_dataset(str(film), data_root=tmp_path, intrinsics=intrinsics)


@pytest.mark.parametrize("where", [".", "rgb"])
def test_a_folder_of_images_takes_intrinsics(tmp_path: Path, sample: SimpleNamespace, where: str) -> None:
    folder = tmp_path / "shots"
    for i in range(3):
        sample.save(folder / where / f"{i}.png", sample.colour(i))
    with pytest.raises(DatasetError, match="--intrinsics"):
        open_dataset(str(folder), data_root=tmp_path)
    dataset = open_dataset(str(folder), data_root=tmp_path, intrinsics=(20.0, 20.0, 11.5, 7.5))
    assert len(dataset) == 3 and not dataset.has_depth
    assert dataset.camera == Camera(24, 16, 20.0, 20.0, 11.5, 7.5)
    np.testing.assert_array_equal(dataset[1].rgb, sample.colour(1)[..., ::-1])


def test_intrinsics_go_before_a_camera_file(make_folder: Callable[..., Path]) -> None:
    folder = make_folder(2)
    dataset = open_dataset(str(folder), data_root=folder, intrinsics=(30.0, 31.0, 11.0, 7.0))
    assert dataset.has_depth and dataset.camera == Camera(24, 16, 30.0, 31.0, 11.0, 7.0)


def test_known_cameras_take_none(make_replica: Callable[..., Path], tmp_path: Path) -> None:
    for seq in ("office", str(make_replica(2))):
        with pytest.raises(DatasetError, match="is known; leave the option out"):
            open_dataset(seq, data_root=tmp_path, intrinsics=INTRINSICS)
