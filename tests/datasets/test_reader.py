# SPDX-License-Identifier: Apache-2.0
"""Frames read ahead by a thread."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ggwarp.datasets import BadFrame, DatasetError, FrameReader, open_dataset
from ggwarp.datasets import reader as reader_module
from ggwarp.datasets.reader import repeated
from ggwarp.datasets.readers.replica import open_sequence
from ggwarp.geometry.camera import Camera
from ggwarp.types import Frame

Maker = Callable[..., Path]


class Counting:
    """A data set in memory that counts what is read of it."""

    name, kind, has_depth, has_masks = "counting", "folder", False, False
    camera = Camera(8, 6, 5.0, 5.0, 3.5, 2.5)

    def __init__(self, fails_at: int = -1) -> None:
        self.read: list[int] = []
        self._fails_at = fails_at

    def __len__(self) -> int:
        return 100

    def __getitem__(self, index: int) -> Frame:
        if index == self._fails_at:
            raise RuntimeError("a bug")
        self.read.append(index)
        return Frame(index, float(index), np.full((6, 8, 3), index, np.uint8))


def test_frames_come_in_the_order_asked_for() -> None:
    with FrameReader(Counting(), range(5, 50, 5)) as reader:
        assert len(reader) == 9
        assert [frame.index for frame in reader] == list(range(5, 50, 5))


def test_no_more_is_read_ahead_than_told() -> None:
    dataset = Counting()
    with FrameReader(dataset, range(100), ahead=3) as reader:
        next(iter(reader))
        deadline = time.monotonic() + 5.0
        while len(dataset.read) < 5 and time.monotonic() < deadline:
            time.sleep(0.01)
        # One handed out, three held ready, one waiting to be.
        assert len(dataset.read) == 5


def test_leaving_early_ends_the_thread() -> None:
    with FrameReader(Counting(), range(100)) as reader:
        for _ in reader:
            break
    assert not [thread for thread in threading.enumerate() if thread.name == "frame-reader"]


def test_it_can_be_read_twice() -> None:
    with FrameReader(Counting(), range(3)) as reader:
        assert [f.index for f in reader] == [f.index for f in reader] == [0, 1, 2]


def test_a_disk_that_does_not_answer_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second frame never comes."""
    answer = threading.Event()

    class Stalled(Counting):
        def __getitem__(self, index: int) -> Frame:
            if index == 1:
                answer.wait()
            return super().__getitem__(index)

    monkeypatch.setattr(reader_module, "_PATIENCE", 0.05)
    with FrameReader(Stalled(), range(3)) as reader:
        for _ in reader:
            break
    answer.set()
    for thread in threading.enumerate():
        if thread.name == "frame-reader":
            thread.join()


def test_nothing_to_read() -> None:
    with FrameReader(Counting(), []) as reader:
        assert list(reader) == []


def test_a_bug_in_the_thread_reaches_the_caller() -> None:
    with FrameReader(Counting(fails_at=2), range(5)) as reader, pytest.raises(RuntimeError, match="a bug"):
        list(reader)


def test_a_bad_frame_is_handed_out_as_such(make_replica: Maker) -> None:
    scene = make_replica(3)
    path = scene / "results/depth000001.png"
    path.write_bytes(path.read_bytes()[:-20])
    with FrameReader(open_sequence(scene), range(3)) as reader:
        items = list(reader)
    assert [isinstance(item, BadFrame) for item in items] == [False, True, False]
    bad = items[1]
    assert isinstance(bad, BadFrame) and bad.index == 1 and "depth000001.png: is truncated" in bad.reason


def test_at_full_size_nothing_is_touched(make_replica: Maker) -> None:
    dataset = open_sequence(make_replica(1))
    with FrameReader(dataset, [0]) as reader:
        (frame,) = reader
    assert isinstance(frame, Frame) and frame.sensor_depth is None
    assert reader.camera == reader.sensor_camera == dataset.camera
    np.testing.assert_array_equal(frame.rgb, dataset[0].rgb)


def halved(ids: np.ndarray) -> np.ndarray:
    """Return the upper left and the lower right of four different ids in turn."""
    rows, columns = np.indices((ids.shape[0] // 2, ids.shape[1] // 2))
    return np.where((rows + columns) % 2 == 0, ids[::2, ::2], ids[1::2, 1::2])


def test_a_scale_resamples_each_in_its_way(make_replica: Maker, sample: SimpleNamespace) -> None:
    scene = make_replica(1)
    ids = (np.arange(16 * 24).reshape(16, 24) % 200).astype(np.uint8)
    sample.save(scene / "object_mask/frame000000.png", ids)
    dataset = open_sequence(scene)
    with FrameReader(dataset, [0], scale=0.5) as reader:
        (frame,) = reader
    native = dataset[0]
    assert isinstance(frame, Frame) and frame.depth is not None and native.depth is not None
    assert reader.camera == Camera(12, 8, 10.0, 10.0, 5.5, 3.5)
    want = cv2.resize(native.rgb, (12, 8), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(frame.rgb, want)
    np.testing.assert_array_equal(frame.depth, np.full((8, 12), 1.0, np.float32))
    np.testing.assert_array_equal(frame.mask, halved(ids))
    np.testing.assert_array_equal(frame.native_mask, ids)
    np.testing.assert_array_equal(frame.sensor_depth, native.depth)


def test_the_true_mask_stays_at_its_own_size(
    make_replica: Maker, sample: SimpleNamespace, tmp_path: Path
) -> None:
    scene = make_replica(1)
    ids = (np.arange(16 * 24).reshape(16, 24) % 200).astype(np.uint8)
    sample.save(scene / "object_mask/frame000000.png", ids)
    sample.save(tmp_path / "mine/frame000000.png", ids + 1)
    with FrameReader(open_sequence(scene, tmp_path / "mine"), [0], scale=0.5) as reader:
        (frame,) = reader
    assert isinstance(frame, Frame)
    np.testing.assert_array_equal(frame.mask, halved(ids) + 1)
    np.testing.assert_array_equal(frame.true_mask, ids)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5, float("nan")])
def test_a_scale_out_of_range_is_refused(scale: float) -> None:
    with pytest.raises(DatasetError, match="scale"):
        FrameReader(Counting(), [0], scale=scale)


def test_real_frames_at_half_size_keep_their_surfaces(recordings: Path) -> None:
    with FrameReader(open_dataset("redkitchen", data_root=recordings), [0, 100], scale=0.5) as reader:
        for frame in reader:
            assert isinstance(frame, Frame) and frame.depth is not None and frame.sensor_depth is not None
            native = frame.sensor_depth.reshape(240, 2, 320, 2).transpose(0, 2, 1, 3).reshape(240, 320, 4)
            lowest = np.where(native > 0, native, np.inf).min(axis=2)
            inside = (frame.depth >= lowest - 1e-4) & (frame.depth <= native.max(axis=2) + 1e-4)
            assert (inside | (frame.depth == 0)).all()


class Stuttering:
    """A dataset whose frames have the depth and the picture of those numbers."""

    camera = Camera(8, 6, 7.0, 7.0, 3.5, 2.5)

    def __init__(self, pairs: list[tuple[int, int]]) -> None:
        self._pairs = pairs

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> Frame:
        rng = [np.random.default_rng(number) for number in self._pairs[index]]
        depth = rng[0].uniform(1.0, 2.0, (6, 8)).astype(np.float32)
        return Frame(index, 0.1 * index, rng[1].integers(0, 255, (6, 8, 3)).astype(np.uint8), depth)


def test_a_picture_that_a_recorder_repeats_is_not_used_twice() -> None:
    dataset = Stuttering([(0, 0), (1, 1), (1, 2), (1, 3), (4, 4), (4, 4), (5, 4), (6, 6)])
    reader = FrameReader(dataset, range(len(dataset)))  # pyright: ignore[reportArgumentType]
    with reader:
        items = list(reader)
    bad = {item.index: item.reason for item in items if isinstance(item, BadFrame)}
    assert list(bad) == [2, 3, 6], "what stands still, in both, is used"
    assert bad[3] == "the depth of frame 2 is there again, beside a new picture: one depth was missed"
    assert bad[6].startswith("the picture of frame 5 is there again, beside a new depth")
    with reader.after(3) as rest:
        items = list(rest)
    assert [type(item) for item in items[:2]] == [BadFrame, Frame], "as if it had never stopped"


def test_flat_pictures_are_no_repetition() -> None:
    flat = Frame(0, 0.0, np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 2.0, np.float32))
    assert repeated(replace(flat, index=1, rgb=flat.rgb + np.uint8(9)), flat) == ""
    assert repeated(flat, None) == "" == repeated(replace(flat, depth=None), flat)
