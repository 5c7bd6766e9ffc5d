# SPDX-License-Identifier: Apache-2.0
"""Frames that come once: what a sender sends, what a camera takes, what is dropped, and how it ends."""

import io
import json
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp.datasets import BadFrame, DatasetError, FrameError, FrameReader, open_dataset
from ggwarp.datasets.base import SequenceEnd, dropped_frames, is_live
from ggwarp.datasets.live.cameras import open_webcam
from ggwarp.datasets.live.sequence import Newest
from ggwarp.datasets.live.stream import open_stream
from ggwarp.types import Frame
from live_frames import HEAD, sent
from recorded_scene import check_truth


class Again:
    """The first frames of a live sequence, held, so that they can be looked at twice."""

    def __init__(self, dataset: object, count: int) -> None:
        self.camera, self._frames = dataset.camera, [dataset[i] for i in range(count)]  # pyright: ignore

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return self._frames[index]


def test_a_stream_is_a_sequence_with_truth() -> None:
    dataset = open_stream(io.BytesIO(sent()))
    assert is_live(dataset) and dataset.has_depth and len(dataset) > 1000
    check_truth(Again(dataset, 3))  # pyright: ignore[reportArgumentType]
    with pytest.raises(FrameError, match="stream: frame 1 came once and is gone"):
        _ = dataset[1]
    with pytest.raises(SequenceEnd):
        _ = dataset[3]


def test_a_reader_ends_where_the_stream_does() -> None:
    dataset = open_stream(io.BytesIO(sent()))
    with FrameReader(dataset, range(len(dataset)), scale=0.5) as reader:
        frames = list(reader)
    assert [frame.index for frame in frames] == [0, 1, 2]
    dataset = open_stream(io.BytesIO(sent(5)))
    with FrameReader(dataset, range(0, 5, 2)) as reader:
        frames = [frame for frame in reader if isinstance(frame, Frame)]
    assert [frame.timestamp for frame in frames] == [5.0, 7.0, 9.0]


def test_colour_alone() -> None:
    dataset = open_stream(io.BytesIO(sent(has_depth=False)))
    assert not dataset.has_depth and dataset[0].depth is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "standard input: is empty; expected a camera first"),
        (b"hello\n", "the first line is no JSON object"),
        (b"[" * 100_000, "the first line is no JSON object"),
        (b"{}\n", "the first line lacks w and h"),
        (json.dumps(HEAD | {"fx": -3}).encode() + b"\n", "fx is -3"),
        (json.dumps(HEAD | {"w": 1e9}).encode() + b"\n", "standard input: w is 1e"),
        (json.dumps(HEAD | {"has_depth": 1}).encode() + b"\n", "has_depth is 1; it must be true or false"),
    ],
)
def test_a_first_line_that_is_no_camera(data: bytes, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        open_stream(io.BytesIO(data))


@pytest.mark.parametrize("keep", [0.4, 0.7, 0.99])
def test_a_stream_that_breaks_off_says_so_and_ends(keep: float) -> None:
    data = sent(3)
    dataset = open_stream(io.BytesIO(data[: int(keep * len(data))]))
    with FrameReader(dataset, range(len(dataset))) as reader:
        *good, last = list(reader)
    assert len(good) == int(3 * keep) and all(isinstance(frame, Frame) for frame in good)
    assert isinstance(last, BadFrame) and "ends within frame" in last.reason


@pytest.mark.parametrize("wrong", [-1, 1.5, 1e12, "many", None])
def test_a_size_that_cannot_be_ends_the_stream(wrong: object) -> None:
    data = json.dumps(HEAD).encode() + b"\n" + json.dumps({"color": wrong}).encode() + b"\n" + bytes(100)
    dataset = open_stream(io.BytesIO(data))
    with pytest.raises(FrameError, match=r"color of frame 0 is .* it must be a number of bytes"):
        _ = dataset[0]
    with pytest.raises(SequenceEnd):
        _ = dataset[1]


def test_a_damaged_picture_is_one_bad_frame() -> None:
    data = bytearray(sent(3))
    at = data.index(b"\xff\xd8\xff", data.index(b"\xff\xd8\xff") + 3)
    data[at : at + 200] = bytes(200)
    dataset = open_stream(io.BytesIO(bytes(data)))
    with FrameReader(dataset, range(len(dataset))) as reader:
        kinds = [type(item) for item in reader]
    assert kinds == [Frame, BadFrame, Frame]


def test_nothing_is_piped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(DatasetError, match="--seq -: nothing is sent; pipe a sender into it"):
        open_dataset("-", data_root=Path())


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "film.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (80, 60))
    for i in range(6):
        video.write(np.full((60, 80, 3), 20 + 30 * i, np.uint8))
    video.release()
    return path


def test_a_webcam_ends_and_counts_what_it_dropped(film: Path) -> None:
    dataset = open_dataset(f"webcam:{film}", data_root=film, intrinsics=(70.0, 70.0, 39.5, 29.5))
    assert is_live(dataset) and not dataset.has_depth
    with FrameReader(dataset, range(len(dataset)), ahead=1) as reader:
        frames = [frame for frame in reader if isinstance(frame, Frame)]
    # The first picture told the size; of the others each is handed out or counted.
    assert len(frames) + dropped_frames(dataset) == 5 and len(frames) >= 2
    shades = [int(frame.rgb.mean()) for frame in frames]
    assert shades == sorted(shades) and [frame.index for frame in frames] == list(range(len(frames)))


def test_the_newest_are_held_and_the_older_dropped() -> None:
    numbers, done = iter(range(10)), threading.Event()

    def take() -> int | None:
        number = next(numbers, None)
        if number is None:
            done.set()
        return number

    newest = Newest(take)
    assert done.wait(10)
    assert list(newest) == [8, 9] and newest.dropped == 8


def test_cameras_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="webcam:x: expected a number"):
        open_webcam("x", (70.0, 70.0, 39.5, 29.5))
    with pytest.raises(DatasetError, match="webcam:77: there is no such camera"):
        open_webcam("77", (70.0, 70.0, 39.5, 29.5))
    with pytest.raises(DatasetError, match=r"realsense:: (needs pyrealsense2|[Nn]o device)"):
        open_dataset("realsense:", data_root=tmp_path)
    with pytest.raises(DatasetError, match="--masks there: --seq - has no masks"):
        open_dataset("-", data_root=tmp_path, masks="there")
