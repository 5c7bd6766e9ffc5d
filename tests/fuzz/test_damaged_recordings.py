# SPDX-License-Identifier: Apache-2.0
"""Damaged recordings of every layout: each is opened or refused in one line, each frame read or refused.

``GGWARP_DAMAGED=1000 python -m pytest tests/fuzz`` tries a thousand; otherwise it is a hundred.
"""

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from bag_recordings import mcap, realsense, ros1, ros2
from damage import damage
from distributed_data_sets import LAYOUTS, sens
from ggwarp.datasets import DatasetError, FrameError
from ggwarp.datasets.plan.sequence_plan import plan_sequence
from phone_recordings import opened, r3d
from recorded_scene import COLOUR, look, millimetres, pose

COUNT = int(os.environ.get("GGWARP_DAMAGED", "100"))
LONGEST_S = 60
FRAMES = 3


def plain(path: Path, kind: str) -> None:
    for i in range(FRAMES):
        rgb, depth = look(COLOUR, pose(i))
        folders = ("results", "results") if kind == "replica" else ("color", "depth")
        names = (
            (f"frame{i:06d}.jpg", f"depth{i:06d}.png") if kind == "replica" else (f"{i}.png", f"{i}.{kind}")
        )
        for folder in folders:
            (path / folder).mkdir(exist_ok=True, parents=True)
        assert cv2.imwrite(str(path / folders[0] / names[0]), rgb[..., ::-1])
        place = path / folders[1] / names[1]
        if kind == "npy":
            np.save(place, depth)
        else:
            assert cv2.imwrite(str(place), millimetres(depth))
        (path / "object_mask").mkdir(exist_ok=True)
        stem = f"frame{i:06d}" if kind == "replica" else str(i)
        assert cv2.imwrite(str(path / f"object_mask/{stem}.png"), (depth > 2).astype(np.uint8))
    names = {
        "w": 80,
        "h": 60,
        "fx": COLOUR.fx,
        "fy": COLOUR.fy,
        "cx": COLOUR.cx,
        "cy": COLOUR.cy,
        "scale": 1000,
    }
    text = str(names).replace("'", '"')
    (path / ("cam_params.json" if kind == "replica" else "camera.json")).write_text(text)
    rows = (" ".join(map(str, pose(i).ravel())) for i in range(FRAMES))
    (path / "traj.txt").write_text("\n".join(rows))


def tum(path: Path) -> None:
    plain(path, "png")
    for name, folder in (("rgb", "color"), ("depth", "depth")):
        (path / f"{name}.txt").write_text("".join(f"{i / 30:.6f} {folder}/{i}.png\n" for i in range(FRAMES)))
    (path / "groundtruth.txt").write_text("".join(f"{i / 30:.6f} {i} 0 0 0 0 0 1\n" for i in range(FRAMES)))


KINDS: dict[str, Callable[[Path], object]] = {
    **LAYOUTS,
    "r3d": lambda path: r3d(path / "scan.r3d"),
    "sens": lambda path: sens(path / "scan.sens"),
    "ros1": lambda path: ros1(path / "scan.bag", registered=False, compressed=True),
    "realsense": lambda path: realsense(path / "scan.bag"),
    "ros2": lambda path: ros2(path / "scan", registered=True, compressed=False),
    "mcap": lambda path: mcap(path / "scan.mcap", registered=False, compressed=False),
    "replica": lambda path: plain(path, "replica"),
    "png": lambda path: plain(path, "png"),
    "tiff": lambda path: plain(path, "tiff"),
    "npy": lambda path: plain(path, "npy"),
    "tum": tum,
}
WITHIN = ("scan.r3d", "scan.sens", "scan.bag", "scan.mcap", "scan")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an undamaged recording of each kind."""
    root = tmp_path_factory.mktemp("whole")
    for name, write in KINDS.items():
        (root / name).mkdir()
        write(root / name)
    return root


class HangsError(BaseException):
    """Passes by all that catches exceptions."""


@pytest.fixture(autouse=True)
def no_hanging() -> Iterator[None]:
    """End a test that waits for ever, as for a pipe."""

    def ring(number: int, frame: object) -> None:
        raise HangsError

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(LONGEST_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def place(folder: Path) -> Path:
    return next((folder / name for name in WITHIN if (folder / name).exists()), folder)


@pytest.mark.parametrize("name", KINDS)
def test_undamaged_recordings_are_read(whole: Path, name: str) -> None:
    dataset = opened(place(whole / name))
    assert len(dataset) == FRAMES
    assert all(dataset[i].depth is not None for i in range(FRAMES))


@pytest.mark.parametrize("seed", range(COUNT))
def test_a_damaged_recording_is_read_or_refused(whole: Path, tmp_path: Path, seed: int) -> None:
    name = list(KINDS)[seed % len(KINDS)]
    folder = tmp_path / name
    shutil.copytree(whole / name, folder)
    done = damage(folder, seed)
    try:
        dataset = opened(place(folder))
        plan_sequence(dataset)
    except DatasetError as error:
        told(error, done)
        return
    good = 0
    for i in range(len(dataset)):
        try:
            frame = dataset[i]
        except FrameError as error:
            told(error, done)
            continue
        good += 1
        shape = (dataset.camera.height, dataset.camera.width)
        assert frame.rgb.shape == (*shape, 3) and frame.rgb.dtype == np.uint8, done
        assert np.isfinite(frame.timestamp), done
        if frame.depth is not None:
            assert frame.depth.shape == shape and frame.depth.dtype == np.float32, done
            assert np.isfinite(frame.depth).all() and (frame.depth >= 0).all(), done
        if frame.T_wc is not None:
            assert np.isfinite(frame.T_wc).all(), done
    assert good, f"opened, but empty: {done}"


def told(error: DatasetError, done: list[str]) -> None:
    """Check that an error is one line that can be printed, and says something."""
    text = str(error)
    assert text.isprintable() and 10 < len(text) < 1500, (done, text)
