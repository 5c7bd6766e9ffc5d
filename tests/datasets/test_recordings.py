# SPDX-License-Identifier: Apache-2.0
"""A table of recordings as people have them: each is opened right, or refused or doubted in words.

A row is a layout and what is odd about it. "Opened right" means that each frame has its own colour and depth,
in metres: frame i of the room is brightest in its blue channel at i, and its wall is 2 + i / 100 metres away.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp.datasets import DatasetError, FrameError, open_dataset
from ggwarp.datasets.plan.sequence_plan import plan_sequence

COUNT = 8
SIZE = (32, 24)
CAMERA = {"w": 32, "h": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}


def bgr(i: int) -> np.ndarray:
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    return np.stack([np.full_like(u, 10 * i), v * 5, u * 5], axis=-1).astype(np.uint8)


def metres(i: int) -> np.ndarray:
    wall = np.full((SIZE[1], SIZE[0]), 2.0 + i / 100.0)
    wall[6:14, 4 + i : 12 + i] -= 0.75 + np.arange(8) / 1000.0
    wall[16:, :] -= np.linspace(0.0, 0.5, SIZE[0])
    return wall


def raw(i: int, scale: float = 1000.0) -> np.ndarray:
    return np.rint(metres(i) * scale).astype(np.uint16)


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix.lower(), image)[1].tobytes())


def folder(
    root: Path,
    *,
    colour: str = "color/{i:05d}.png",
    depth: str = "depth/{i:05d}.png",
    scale: float = 1000.0,
    told: float | None = None,
    camera: dict | str | None = None,
    name: str = "camera.json",
    start: int = 0,
    lag: float = 0.0,
    frames: range = range(COUNT),
    depth_of: Callable[[int], np.ndarray] | None = None,
) -> None:
    """Write a plain folder.

    Patterns know ``i`` (``start`` later for colour), and the time as ``t``, ``ms`` and ``ns`` (``lag`` later
    for depth). A metre is ``scale``, and ``told`` where the camera file says something else.
    """
    for i in range(COUNT):
        t = 1_700_000_000.0 + i / 15
        write(root / colour.format(i=i + start, t=t, ns=int(t * 1e6) * 1000, ms=int(t * 1e3)), bgr(i))
        if i in frames:
            s = t + lag
            image = raw(i, scale) if depth_of is None else depth_of(i)
            write(root / depth.format(i=i, t=s, ns=int(s * 1e6) * 1000, ms=int(s * 1e3)), image)
    text = camera if isinstance(camera, str) else json.dumps((camera or CAMERA) | {"scale": told or scale})
    (root / name).write_text(text)


def lists(
    root: Path, *, order: list[int] | None = None, unit: float = 1.0, lag: float = 0.006, again: bool = False
) -> None:
    """Write TUM's layout."""
    folder(root, colour="rgb/{i}.png", depth="depth/{i}.png", scale=5000.0)
    for name, late in (("rgb", 0.0), ("depth", lag)):
        rows = [f"{(1_700_000_000.0 + i / 15 + late) * unit:.6f} {name}/{i}.png" for i in range(COUNT)]
        rows = [rows[i] for i in order or range(COUNT)]
        (root / f"{name}.txt").write_text("\n".join(rows + rows[:2] * again) + "\n")


def replica(root: Path, *, other: str = "") -> None:
    folder(root, colour="results/frame{i:06d}.jpg", depth="results/depth{i:06d}.png", name="cam_params.json")
    if other:
        (root / other).mkdir()


K = [[30.0, 0.0, 15.5], [0.0, 30.0, 11.5], [0.0, 0.0, 1.0]]
FLAT = [value for row in K for value in row]
RIGHT: dict[str, Callable[[Path], None]] = {
    "control": folder,
    "unpadded numbers": lambda r: folder(r, colour="color/{i}.png", depth="depth/{i}.png"),
    "other prefixes": lambda r: folder(r, colour="rgb/rgb_{i:04d}.png", depth="depth/d{i}.png"),
    "number, then tag": lambda r: folder(r, colour="rgb/{i}_cam0.png", depth="depth/d{i}_cam0.png"),
    "tags differ": lambda r: folder(r, colour="rgb/{i:04d}_cam0_l.png", depth="depth/{i:04d}_cam1_l.png"),
    "sizes in names": lambda r: folder(r, colour="rgb/{i}_1920x1080.png", depth="depth/{i}_640x480.png"),
    "seconds": lambda r: folder(r, colour="rgb/{t:.6f}.png", depth="depth/{t:.6f}.png", lag=0.006),
    "nanoseconds": lambda r: folder(r, colour="rgb/{ns}.png", depth="depth/{ns}.png", lag=0.006),
    "milliseconds": lambda r: folder(r, colour="rgb/{ms}.png", depth="depth/{ms}.png", lag=0.006),
    "colour of another spelling": lambda r: folder(r, colour="Colour/{i}.PNG", depth="Depth/{i}.PNG"),
    "nerfstudio's folders": lambda r: folder(r, colour="images/{i}.png", depth="depths/{i}.png"),
    "spaces and accents": lambda r: folder(r / "Büro (1)", colour="color/{i}.png", depth="depth/{i}.png"),
    "a scale of its own": lambda r: folder(r, scale=5000.0),
    "scale beside the camera": lambda r: folder(
        r, scale=5000.0, camera=json.dumps({"camera": CAMERA, "scale": 5000.0})
    ),
    "a matrix by rows": lambda r: folder(
        r, camera=json.dumps({"intrinsic_matrix": FLAT}), name="camera_intrinsic.json"
    ),
    "a matrix by columns": lambda r: folder(
        r, camera=json.dumps({"intrinsic_matrix": np.transpose(K).ravel().tolist()}), name="intrinsic.json"
    ),
    "a matrix on a line": lambda r: folder(r, camera=" ".join(map(str, FLAT)), name="intrinsics.txt"),
    "a matrix as text": lambda r: folder(
        r, camera="\ufeff" + "\r\n".join(" ".join(map(str, row)) for row in K), name="intrinsics.txt"
    ),
    "another program's results": lambda r: (folder(r), (r / "results").mkdir(), None)[-1],
    "Replica": replica,
    "Replica with a folder more": lambda r: replica(r, other="images_old"),
    "lists": lists,
    "lists out of order": lambda r: lists(r, order=[3, 0, 7, 1, 2, 6, 5, 4]),
    "lists with doubles": lambda r: lists(r, again=True),
    "lists in nanoseconds": lambda r: lists(r, unit=1e9),
    "lists in milliseconds": lambda r: lists(r, unit=1e3),
    "one-based colour": lambda r: folder(r, colour="color/{i}.png", depth="depth/{i}.png", start=1),
    "colour and depth in one folder": lambda r: folder(r, colour="{i}_color.png", depth="{i}_depth.png"),
    "colour, depth and normals in one": lambda r: (
        folder(r, colour="rgb/{i}_rgb.png", depth="rgb/{i}_depth.png"),
        [write(r / f"rgb/{i}_normal.png", bgr(i)) for i in range(COUNT)],
        None,
    )[-1],
    "a metadata.json of one's own": lambda r: (
        folder(r, colour="rgb/{i}.png"),
        (r / "metadata.json").write_text('{"author": "me"}'),
        None,
    )[-1],
    "an app's frame beside": lambda r: (
        folder(r),
        write(r / "frame_00000.jpg", bgr(0)),
        (r / "frame_00000.json").write_text("{}"),
        None,
    )[-1],
    "intrinsics.json": lambda r: folder(r, name="intrinsics.json"),
}  # fmt: skip


@pytest.mark.parametrize("kind", RIGHT)
def test_a_recording_is_opened_right(tmp_path: Path, kind: str) -> None:
    RIGHT[kind](tmp_path)
    root = next((p for p in tmp_path.iterdir() if p.name.startswith("Büro")), tmp_path)
    dataset = open_dataset(str(root), data_root=tmp_path)
    assert len(dataset) == COUNT
    assert (dataset.camera.fx, dataset.camera.cx, dataset.camera.cy) == (30.0, 15.5, 11.5)
    for i in range(COUNT):
        frame = dataset[i]
        assert frame.depth is not None and abs(int(frame.rgb[12, 16, 2]) - 10 * i) <= 4
        np.testing.assert_allclose(frame.depth, metres(i), atol=6e-4)
    plan = plan_sequence(dataset)
    assert f"{COUNT} pairs by" in plan.pairing and plan.camera and "units a metre" in plan.depth
    assert not [w for w in plan.warnings if "sorted" not in w and "again" not in w and "written by" not in w
                and "taken for" not in w and "paired in their order" not in w]  # fmt: skip


def stretched(i: int) -> np.ndarray:
    return np.rint(metres(i) / metres(i).max() * 65534).astype(np.uint16)


def two_eyes(root: Path) -> None:
    for side in ("l", "r"):
        folder(root, colour=f"color/{{i}}_{side}.png", depth="depth/x{i}.png")


SHARES = {"w": 32, "h": 24, "fx": 0.94, "fy": 1.25, "cx": 0.5, "cy": 0.5}


REFUSED: dict[str, tuple[Callable[[Path], None], str]] = {
    "metres cut to whole numbers": (lambda r: folder(r, scale=1.0, told=1000.0), "cut to whole"),
    "depth in 8 bits": (
        lambda r: folder(r, depth_of=lambda i: (metres(i) * 80).astype(np.uint8)),
        "uint8; depth must be",
    ),
    "a picture of depth": (lambda r: folder(r, depth_of=bgr), "3 channel"),
    "each picture stretched": (
        lambda r: folder(r, depth_of=stretched),
        "each stretched to its own range",
    ),
    "a unit that no camera has": (lambda r: folder(r, scale=20.0, told=10000.0), "no camera sees that"),
    "intrinsics of larger images": (
        lambda r: folder(r, camera={"fx": 130.0, "fy": 130.0, "cx": 66.0, "cy": 49.0}),
        "lies outside the 32x24 images: are they of another size",
    ),
    "intrinsics in shares": (lambda r: folder(r, camera=SHARES), "normalised intrinsics"),
    "a fisheye model": (lambda r: folder(r, camera=CAMERA | {"model": "equidistant"}), "undistort the im"),
    "a folder deeper": (lambda r: folder(r / "mine/walk"), r"but .*mine/walk is one: --seq .*mine/walk"),
    "a fisheye lens": (lambda r: folder(r, camera=CAMERA | {"camera_model": "OPENCV_FISHEYE"}), "not read"),
    "y upwards": (lambda r: folder(r, camera=CAMERA | {"fy": -30.0}), "fy is -30; it must be positive"),
    "two pictures of a number": (two_eyes, "the names do not tell which depth images"),
    "no name in common": (
        lambda r: folder(r, depth="depth/{i}00.png", start=1000),
        "no two have the same name, number or time",
    ),
    "clocks far apart": (lambda r: lists(r, lag=100.0), r"within 0\.02 s .*1700000100"),
    "depth of an unknown kind": (
        lambda r: (folder(r), [p.rename(p.with_suffix(".raw")) for p in (r / "depth").iterdir()], None)[-1],
        r"depth: holds 8 \.raw, but depth is read from",
    ),
    "no camera": (lambda r: (folder(r), (r / "camera.json").unlink(), None)[-1], "no camera file"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_a_recording_that_cannot_be_right_is_refused(tmp_path: Path, kind: str) -> None:
    make, says = REFUSED[kind]
    make(tmp_path)
    with pytest.raises(DatasetError, match=says) as error:
        plan_sequence(open_dataset(str(tmp_path), data_root=tmp_path))
    assert "\n" not in str(error.value) and not isinstance(error.value, FrameError)


DOUBTED: dict[str, tuple[Callable[[Path], None], str]] = {
    "half as many depth images": (lambda r: folder(r, frames=range(4)), "8 colour images and 4 depth images"),
    "one-based colour": (lambda r: folder(r, start=1), "differ by 1"),
    "a unit ten times too fine": (lambda r: folder(r, told=100.0), "20.1 m, as 100 is taken for a metre"),
    "intrinsics of smaller images": (
        lambda r: folder(r, camera=CAMERA | {"fx": 15.0, "fy": 15.0, "cx": 7.5, "cy": 5.5}),
        "lies far from the middle",
    ),
    "cx and cy exchanged": (
        lambda r: folder(r, camera=CAMERA | {"cx": 11.5, "cy": 15.5}),
        "are cx and cy exchanged",
    ),
    "intrinsics of images a quarter larger": (
        lambda r: folder(r, camera={"fx": 37.5, "fy": 37.5, "cx": 19.5, "cy": 14.5}),
        "the intrinsics of images of 40x30?",
    ),
    "bits rotated by three": (
        lambda r: folder(r, depth_of=lambda i: raw(i) << 3 | raw(i) >> 13),
        "as SUN RGB-D has them",
    ),
    "two cameras in a folder": (
        lambda r: [folder(r, colour=f"rgb/{c}_{{i}}.png", depth=f"depth/{c}_{{i}}.png") for c in "lr"][-1],
        "(l_0.png, r_0.png): by several cameras?",
    ),
    "depth in a folder of another name": (
        lambda r: folder(r, depth="aligned_depth_to_color/{i}.png"),
        "aligned_depth_to_color/ (8 .png) is not read: depth is read from depth/",
    ),
    "a lens that nobody knows": (lambda r: folder(r, camera=CAMERA | {"camera_model": "X1"}), "X1"),
    "times in nanoseconds": (lambda r: lists(r, unit=1e9), "its times are taken for ns"),
}  # fmt: skip


@pytest.mark.parametrize("kind", DOUBTED)
def test_a_recording_that_may_be_right_is_doubted(tmp_path: Path, kind: str) -> None:
    make, says = DOUBTED[kind]
    make(tmp_path)
    plan = plan_sequence(open_dataset(str(tmp_path), data_root=tmp_path))
    assert any(says in warning for warning in plan.warnings), plan.warnings
