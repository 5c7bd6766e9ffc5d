# SPDX-License-Identifier: Apache-2.0
"""A phone on a cable, by Record3D's own library, from a phone that is not one."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fake_iphone import UDID, FakePhone
from ggwarp.datasets import DatasetError, FrameError, open_dataset
from ggwarp.datasets.base import SequenceEnd, dropped_frames, is_live
from ggwarp.datasets.live import record3d
from ggwarp.datasets.plan.sequence_plan import plan_sequence
from ggwarp.types import Frame
from recorded_scene import COLOUR, check_truth

pytest.importorskip("record3d", reason="Record3D's library has no wheel here")


class Held:
    """Frames that have come, so that they can be looked at twice."""

    camera = COLOUR

    def __init__(self, frames: list[Frame]) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return self._frames[index]


@pytest.fixture
def phone(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakePhone]:
    with FakePhone() as found:
        monkeypatch.setenv("USBMUXD_SOCKET_ADDRESS", found.address)
        yield found


@pytest.mark.parametrize("which", ["", UDID[:8]])
def test_a_phones_frames_have_depth_camera_and_truth(phone: FakePhone, which: str) -> None:
    phone.send(0)
    dataset = open_dataset(f"record3d:{which}", data_root=Path())
    assert is_live(dataset) and dataset.has_depth and dataset.kind == "record3d"
    assert dataset.camera.fx == pytest.approx(COLOUR.fx) and dataset.camera.cy == pytest.approx(COLOUR.cy)
    frames = []
    for i in range(4):  # frame 1 is taken with a longer focal length
        phone.send(i)
        frames.append(dataset[i])
    check_truth(Held(frames))  # pyright: ignore[reportArgumentType]
    assert (frames[0].depth[:6] == 0).all(), "low confidence is left out"
    assert frames[0].depth_weight[9:14].max() == 0.5 and frames[0].depth_weight[20:].min() == 1.0
    assert dropped_frames(dataset) == 0
    plan = plan_sequence(dataset)
    assert plan.layout.startswith(f"Record3D's USB stream of {UDID}, as they come") and not plan.warnings
    phone.stop()
    with pytest.raises(SequenceEnd):
        _ = dataset[4]
    with pytest.raises(FrameError, match="record3d: frame 0 came once and is gone"):
        _ = dataset[0]


def test_a_phone_that_is_not_there(phone: FakePhone, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DatasetError, match=rf"record3d:beef: there is no such device \(found: {UDID}\)"):
        open_dataset("record3d:beef", data_root=Path())
    with FakePhone(devices=0) as none:
        monkeypatch.setenv("USBMUXD_SOCKET_ADDRESS", none.address)
        with pytest.raises(DatasetError, match="found: none; plug it in, unlock it"):
            open_dataset("record3d:", data_root=Path())


def test_an_app_that_does_not_send(phone: FakePhone, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record3d, "PATIENCE_S", 0.3)
    with pytest.raises(
        DatasetError, match=r"no picture came within 0\.3 s; open Record3D on it, switch on USB"
    ):
        open_dataset("record3d:", data_root=Path())
    with FakePhone(listening=False) as deaf:
        monkeypatch.setenv("USBMUXD_SOCKET_ADDRESS", deaf.address)
        with pytest.raises(DatasetError, match="the device does not answer; open Record3D on it"):
            open_dataset("record3d:", data_root=Path())


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "record3d", None)
    with pytest.raises(DatasetError, match=r"needs record3d; pip install 'ggwarp\[record3d\]'"):
        open_dataset("record3d:", data_root=Path())
    with pytest.raises(DatasetError, match="--masks there: --seq record3d: has no masks"):
        open_dataset("record3d:", data_root=Path(), masks="there")
