# SPDX-License-Identifier: Apache-2.0
"""Recordings in the TUM layout: association, cameras, undistortion."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ggwarp.datasets import DatasetError, FrameError, open_dataset
from ggwarp.datasets.readers.tum import POSE_GAP, POSE_TOLERANCE, interpolated, open_sequence
from ggwarp.geometry import se3

Maker = Callable[..., Path]


def test_each_colour_image_takes_the_nearest_depth_and_the_pose_between(make_tum: Maker) -> None:
    folder = make_tum([1.0, 1.1, 1.2], [0.99, 1.115, 1.105, 1.221], [0.95, 1.05, 1.12, 1.19])
    dataset = open_sequence(folder)
    # 1.2 has no depth within 0.02 s; 1.1 takes depth 2, not 1.
    assert len(dataset) == 2
    frames = [dataset[i] for i in range(2)]
    assert [frame.timestamp for frame in frames] == [1.0, 1.1]
    assert [int(frame.rgb[0, 0, 2]) for frame in frames] == [0, 1]
    depths = [frame.depth[5, 5] for frame in frames if frame.depth is not None]
    np.testing.assert_allclose(depths, [1000 / 5000, 1002 / 5000])
    places = [None if frame.T_wc is None else frame.T_wc[0, 3] for frame in frames]
    assert places == pytest.approx([0.5, 1.0 + 5 / 7])


def test_a_pose_too_far_in_time_is_unknown(make_tum: Maker) -> None:
    dataset = open_sequence(make_tum([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [1.004, 2.006, 2.96, 3.08]))
    assert dataset[0].T_wc is not None and dataset[1].T_wc is None and dataset[2].T_wc is None


def test_a_pose_between_two_turns_evenly() -> None:
    ends = [se3.se3_exp([0, 0, 0, 0, 0, angle]) for angle in (0.2, 0.6)]
    (T_wc,) = interpolated(np.array([0.025]), np.array([0.0, 0.1]), ends)
    np.testing.assert_allclose(T_wc, se3.se3_exp([0, 0, 0, 0, 0, 0.3]), atol=1e-12)


def test_poses_that_are_none_are_passed_over() -> None:
    """A damaged row is as good as a missing one."""
    first, last = np.eye(4), se3.se3_exp([1, 0, 0, 0, 0, 0])
    found = interpolated(np.array([0.03, 0.5]), np.array([0.06, 0.03, 0.0]), [last, None, first])
    np.testing.assert_allclose(found[0], se3.se3_exp([0.5, 0, 0, 0, 0, 0]), atol=1e-12)
    assert found[1] is None


@given(
    stamps=st.lists(st.floats(0, 1), max_size=8).map(np.array),
    others=st.lists(st.floats(0, 1), max_size=8).map(np.array),
)
def test_an_interpolated_pose_lies_between_rows_that_are_close(
    stamps: np.ndarray, others: np.ndarray
) -> None:
    """Poses move at 1 m/s: each place tells the time it was made for."""
    poses = [se3.se3_exp([t, 0, 0, 0, 0, 0]) for t in others.tolist()]
    for stamp, T_wc in zip(stamps.tolist(), interpolated(stamps, others, poses), strict=True):
        before, after = others[others <= stamp], others[others >= stamp]
        close = len(before) and len(after) and after.min() - before.max() <= POSE_GAP
        there = len(others) and np.abs(others - stamp).min() <= POSE_TOLERANCE
        if there:
            assert T_wc is not None and abs(T_wc[0, 3] - stamp) <= POSE_TOLERANCE
        elif close:
            assert T_wc is not None and T_wc[0, 3] == pytest.approx(stamp, abs=1e-9)
        else:
            assert T_wc is None


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt"])
def test_a_recording_without_one_of_its_lists_is_no_plain_folder(make_tum: Maker, name: str) -> None:
    folder = make_tum([0.0], [0.0], [0.0])
    (folder / name).unlink()
    with pytest.raises(DatasetError, match=rf"own: {name} is missing"):
        open_dataset(str(folder), data_root=folder)
    (folder / ("depth.txt" if name == "rgb.txt" else "rgb.txt")).unlink()
    with pytest.raises(DatasetError, match="groundtruth"):
        open_dataset(str(folder), data_root=folder)


@pytest.mark.parametrize(
    "name", ["/dev/zero", "../other.png", "rgb/../../other.png", "/etc/passwd", "rgb", "a\0b"]
)
def test_a_name_that_is_no_file_of_the_recording_costs_its_frame(
    make_tum: Maker, sample: SimpleNamespace, name: str
) -> None:
    folder = make_tum([0.0, 1.0, 2.0], [0.0, 1.0, 2.0])
    sample.save(folder.parent / "other.png", sample.colour(1))
    for file in ("rgb.txt", "depth.txt"):
        lines = (folder / file).read_text().splitlines()
        (folder / file).write_text("\n".join([*lines[:2], f"1.0 {name}", lines[3]]))
    dataset = open_sequence(folder)
    assert len(dataset) == 3 and dataset[2].timestamp == 2.0
    with pytest.raises(FrameError, match=r"lies outside|is a folder|no file can have"):
        dataset[1]


def test_a_link_in_the_recording_may_lead_out_of_it(
    make_tum: Maker, sample: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make_tum([0.0], [0.0])
    (folder / "rgb").rename(folder.parent / "elsewhere")
    (folder / "rgb").symlink_to(folder.parent / "elsewhere")
    assert open_sequence(folder)[0].rgb.shape == (16, 24, 3)
    monkeypatch.chdir(folder.parent)
    assert open_sequence(Path("own"))[0].rgb.shape == (16, 24, 3)


def test_without_truth_a_recording_runs(make_tum: Maker) -> None:
    assert open_sequence(make_tum([0.0], [0.0]))[0].T_wc is None


def test_a_nan_pose_is_unknown(make_tum: Maker, caplog: pytest.LogCaptureFixture) -> None:
    folder = make_tum([0.0, 1.0], [0.0, 1.0], [0.0, 1.0])
    (folder / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n")
    dataset = open_sequence(folder)
    assert dataset[0].T_wc is not None and dataset[1].T_wc is None
    assert "line 2" in caplog.text


def test_quaternions_come_with_w_last(make_tum: Maker) -> None:
    folder = make_tum([0.0], [0.0], [0.0])
    half = 0.5**0.5
    (folder / "groundtruth.txt").write_text(f"0 1 2 3 0 0 {half} {half}\n")
    T_wc = open_sequence(folder)[0].T_wc
    np.testing.assert_allclose(T_wc, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(("number", "fx"), [(1, 517.306408), (2, 520.90862), (3, 535.4)])
def test_the_camera_follows_from_the_name(
    tmp_path: Path, sample: SimpleNamespace, number: int, fx: float
) -> None:
    folder = tmp_path / f"rgbd_dataset_freiburg{number}_desk"
    sample.save(folder / "rgb/1.png", np.full((480, 640, 3), 200, np.uint8))
    sample.save(folder / "depth/1.png", np.full((480, 640), 10000, np.uint16))
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text(f"1 {kind}/1.png\n")
    dataset = open_sequence(folder)
    assert dataset.camera.fx == fx
    frame = dataset[0]
    assert frame.depth is not None
    # Where the undistorted picture has no colour it has no depth either.
    black = frame.rgb.max(axis=2) == 0
    assert black.any() == (number != 3)
    assert (frame.depth[black] == 0).all() and frame.depth[240, 320] == 2.0


def test_colour_and_masks_are_undistorted_and_depth_is_not(make_tum: Maker, sample: SimpleNamespace) -> None:
    """A straight line in space, drawn as the lens bends it, comes out straight."""
    K = np.array([[20, 0, 11.5], [0, 20, 7.5], [0, 0, 1.0]])
    distortion = np.array([0.3, 0.1, 0.0, 0.0, 0.0])
    folder = make_tum([0.0], [0.0], calibration="20 20 11.5 7.5 0.3 0.1 0 0")
    u = np.arange(sample.width, dtype=np.float64)
    ray = np.stack([(u - 11.5) / 20, np.full_like(u, (3 - 7.5) / 20), np.ones_like(u)], axis=1)
    bent = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    image = np.full((sample.height, sample.width, 3), 10, np.uint8)
    for x, y in np.rint(bent).astype(int):
        if 0 <= x < sample.width and 0 <= y < sample.height:
            image[y, x] = 250
    sample.save(folder / "rgb/0.000000.png", image)
    sample.save(folder / "object_mask/0.000000.png", (image[..., 0] > 100).astype(np.uint8) * 9)
    frame = open_sequence(folder)[0]
    assert frame.mask is not None and frame.depth is not None
    inner = slice(6, 18)
    assert (frame.mask[3, inner] == 9).mean() > 0.8 and (frame.rgb[3, inner, 0] > 120).mean() > 0.8
    assert set(np.unique(frame.mask)) == {0, 9}
    seen = frame.depth > 0
    assert (frame.depth[seen] == np.float32(0.2)).all() and 0.6 < seen.mean() < 1.0


def test_a_camera_file_goes_before_the_name(make_tum: Maker) -> None:
    folder = make_tum([0.0], [0.0], name="rgbd_dataset_freiburg1_own")
    assert open_sequence(folder).camera.fx == 20.0


def test_an_unknown_camera_says_what_to_write(make_tum: Maker) -> None:
    with pytest.raises(DatasetError, match=r"which camera\?.*calibration\.txt"):
        open_sequence(make_tum([0.0], [0.0], calibration=None))


def test_no_pair_in_time(make_tum: Maker) -> None:
    with pytest.raises(DatasetError, match=r"within 0\.02 s.*rgb\.txt lists 1 .*, depth\.txt 1 "):
        open_sequence(make_tum([0.0], [0.5]))


def test_empty_lists(make_tum: Maker) -> None:
    with pytest.raises(DatasetError, match=r"rgb\.txt lists 0"):
        open_sequence(make_tum([], []))


@pytest.mark.parametrize(
    ("file", "line", "says"),
    [
        ("rgb.txt", "one rgb/1.png", "'one' is not a number"),
        ("rgb.txt", "nan rgb/1.png", "nan is not a time"),
        ("depth.txt", "1.0", "expected a time and a file name"),
        ("groundtruth.txt", "1 2 3", "3 numbers; expected t tx ty tz"),
    ],
)
def test_malformed_lists_are_named(make_tum: Maker, file: str, line: str, says: str) -> None:
    folder = make_tum([0.0], [0.0], [0.0])
    (folder / file).write_text(f"# comment\n{line}\n")
    with pytest.raises(DatasetError, match=says) as error:
        open_sequence(folder)
    assert f"{file}:2" in str(error.value)


def test_a_real_recording(recordings: Path) -> None:
    dataset = open_dataset("fr1/xyz", data_root=recordings)
    assert len(dataset) == 40
    frame = dataset[0]
    assert frame.timestamp == pytest.approx(1305031102.175304) and frame.T_wc is not None
    assert frame.depth is not None and 0.5 < (frame.depth > 0).mean() < 1.0
    assert frame.depth.max() < 10.0


def test_lists_in_any_order_and_unit_are_one_recording(make_tum: Maker) -> None:
    first = 1_700_000_000
    folder = make_tum([first + t for t in (1.0, 1.1, 1.2)], [first + t for t in (1.006, 1.106, 1.206)])
    for name in ("rgb", "depth"):
        rows = (folder / f"{name}.txt").read_text().splitlines()[1:]
        nanoseconds = [
            f"{int(float(row.split()[0]) * 1e6) * 1000} {row.split()[1]}"
            for row in (rows[2], rows[0], rows[1])
        ]
        (folder / f"{name}.txt").write_text("\n".join([*nanoseconds, nanoseconds[0]]) + "\n")
    (folder / "groundtruth.txt").write_text(f"{first}101 7 0 0 0 0 0 1\n")
    dataset = open_sequence(folder)
    assert [round(dataset[i].timestamp - first, 3) for i in range(3)] == [1.0, 1.1, 1.2]
    assert [int(dataset[i].rgb[0, 0, 2]) for i in range(3)] == [0, 1, 2]
    notes = " ".join(dataset.source.notes)
    for said in (
        "rgb.txt: its times are taken for ns",
        "depth.txt: is not in order of time",
        "rgb.txt: names 1 files again",
    ):
        assert said in notes


def test_no_depth_image_is_used_twice(make_tum: Maker) -> None:
    dataset = open_sequence(make_tum([i / 60 for i in range(6)], [i / 30 for i in range(3)]))
    assert [dataset[i].timestamp for i in range(len(dataset))] == pytest.approx(
        [0.0, 1 / 30, 2 / 30], abs=1e-6
    )
    assert "3 colour images without a partner" in dataset.source.pairing


def test_truth_of_another_clock_is_told(make_tum: Maker) -> None:
    (note,) = open_sequence(make_tum([100.0, 101.0], [100.0, 101.0], [0.0, 1.0])).source.notes
    assert (
        "groundtruth.txt has 2 poses (0.00 to 1.00 s), but none within 0.11 s of an image (100.00 to" in note
    )
