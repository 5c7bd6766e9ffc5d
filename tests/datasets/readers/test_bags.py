# SPDX-License-Identifier: Apache-2.0
"""Bags that rosbags and mcap have written: topics, units, places and times are found, truth agrees."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bag_recordings import FRAMES, mcap, realsense, ros1, ros2
from ggwarp.datasets import DatasetError, FrameError
from ggwarp.datasets.source import source_of
from phone_recordings import opened
from recorded_scene import check_truth

BAGS: dict[str, Callable[..., Path]] = {
    "ros1": lambda path, **how: ros1(path / "walk.bag", **how),
    "ros2": lambda path, **how: ros2(path / "walk", **how),
    "ros2-mcap": lambda path, **how: ros2(path / "walk", storage="mcap", **how),
    "db3": lambda path, **how: next(ros2(path / "walk", **how).glob("*.db3")),
    "mcap": lambda path, **how: mcap(path / "walk.mcap", **how),
}


@pytest.mark.parametrize("name", BAGS)
@pytest.mark.parametrize(("registered", "compressed"), [(True, False), (False, False), (False, True)])
def test_a_bag(tmp_path: Path, name: str, registered: bool, compressed: bool) -> None:
    dataset = opened(BAGS[name](tmp_path, registered=registered, compressed=compressed))
    assert dataset.kind == "bag" and len(dataset) == FRAMES and dataset.has_depth
    check_truth(dataset)
    frame = dataset[1]
    assert frame.timestamp == pytest.approx(1.7e9 + 1 / 30, abs=1e-6)
    assert frame.depth_timestamp == pytest.approx(frame.timestamp + 0.004, abs=1e-6)
    source = source_of(dataset)
    assert source.unread == ("/camera/infra1/image_raw",) and not source.notes
    np.testing.assert_array_equal(dataset[0].rgb, opened_again(dataset, 0))


def opened_again(dataset: object, index: int) -> np.ndarray:
    """Read another frame, then ``index`` once more."""
    _ = dataset[2]  # pyright: ignore[reportIndexIssue]
    return dataset[index].rgb  # pyright: ignore[reportIndexIssue]


def test_realsense(tmp_path: Path) -> None:
    dataset = opened(realsense(tmp_path / "d435.bag"))
    check_truth(dataset)
    assert "10000 units a metre, from /device_0" in source_of(dataset).depth_unit


def test_a_depth_camera_of_which_nothing_says_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ros1(tmp_path / "walk.bag", registered=False, compressed=False)
    monkeypatch.setattr("ggwarp.datasets.bags.reader.static_transforms", lambda bag: {})
    assert any("taken to be the same place" in note for note in source_of(opened(path)).notes)


@pytest.mark.parametrize("name", ["ros1", "mcap"])
@pytest.mark.parametrize("keep", [0, 10, 300, 0.5, 0.98])
def test_a_bag_cut_short_is_refused(tmp_path: Path, name: str, keep: float) -> None:
    path = BAGS[name](tmp_path, registered=True, compressed=False)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(
        DatasetError, match=rf"{path.name}: (is no bag that can be read|has no summary|is damaged)"
    ):
        opened(path)


def test_a_damaged_picture_spoils_one_frame(tmp_path: Path) -> None:
    path = ros1(tmp_path / "walk.bag", registered=True, compressed=True)
    data = bytearray(path.read_bytes())
    at = [i for i in range(len(data)) if data.startswith(b"\xff\xd8\xff", i)][1]
    data[at : at + 2] = b"\x00\x00"
    path.write_bytes(data)
    dataset = opened(path)
    with pytest.raises(FrameError, match=r"walk\.bag/camera/color/image_raw/compressed/\d+: is not an image"):
        _ = dataset[1]
    assert dataset[2].rgb.any()
