# SPDX-License-Identifier: Apache-2.0
"""Depth brought onto the colour's pixels: a scene of planes whose depth is known in every camera."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import recorded_scene as room
from ggwarp.datasets import DatasetError, open_dataset
from ggwarp.datasets.resize import enlarge_depth
from ggwarp.datasets.rig import Lens, Rig
from ggwarp.datasets.source import source_of
from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera

COLOUR = Camera(160, 120, 140.0, 141.0, 80.3, 58.9)
DEPTH = Camera(80, 66, 62.0, 63.0, 39.0, 33.5)
BENT = (0.12, -0.05, 0.001, -0.0008, 0.01)
ORIGIN = np.eye(4)
NORMAL, OFFSET = np.array([0.2, -0.1, 1.0]), 2.5
BOX = (-0.3, 0.2, -0.2, 0.3, 1.4)  # x from, x to, y from, y to, z: stands before the plane, in the world


def seen_by(camera: Camera, T_wc: np.ndarray, distortion: tuple[float, ...] = ()) -> np.ndarray:
    """Return the depth [h, w] of the scene from ``T_wc``, ray by ray."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    if distortion:
        bent = np.stack([u, v], -1).reshape(-1, 1, 2)
        K = camera.matrix
        u, v = cv2.undistortPoints(bent, K, np.array(distortion), P=K).reshape(*u.shape, 2).transpose(2, 0, 1)
    rays = camera.rays(u, v) @ T_wc[:3, :3].T
    origin = T_wc[:3, 3]
    plane = (OFFSET - origin @ NORMAL) / (rays @ NORMAL)
    box = (BOX[4] - origin[2]) / rays[..., 2]
    x, y = (origin[i] + box * rays[..., i] for i in (0, 1))
    hit = (x > BOX[0]) & (x < BOX[1]) & (y > BOX[2]) & (y < BOX[3])
    return np.where(hit, box, plane).astype(np.float32)


def straight(i: int) -> np.ndarray:
    """Return the room's pose ``i``, from one that faces its far wall and the box."""
    return se3.inverse(room.pose(0)) @ room.pose(i)


def away_from_edges(depth: np.ndarray, margin: int = 3) -> np.ndarray:
    """Return [h, w] where the scene has no edge near by."""
    kernel = np.ones((2 * margin + 1,) * 2, np.uint8)
    return cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) < 0.4


def test_smaller_depth_of_the_same_view_is_enlarged() -> None:
    want = seen_by(COLOUR, np.eye(4))
    small = seen_by(COLOUR.resized(40, 30), np.eye(4))
    got = Rig(Lens(COLOUR)).depth(small)
    far = away_from_edges(want, 5)
    np.testing.assert_allclose(got[far][8:-8], want[far][8:-8], rtol=2e-2)
    inner = np.s_[4:-4, 4:-4]
    assert np.abs(got - want)[inner][far[inner]].max() < 2e-3  # linear, not steps of a coarse pixel
    # At an edge it is one surface or the other, never between.
    assert not ((got > 1.45) & (got < 2.0)).any()


def test_enlarging_keeps_holes_and_never_reads_outside(rng: np.random.Generator) -> None:
    depth = rng.uniform(1.0, 1.01, (6, 8)).astype(np.float32)
    depth[2:4, 3:5] = 0.0
    got = enlarge_depth(depth, 32, 24)
    assert got.min() == 0.0 and got[got > 0].min() >= 1.0 and got.max() <= 1.01
    assert (got[8:16, 12:20] == 0.0).all() and (got[:6] > 0.0).all() and (got[:, :10] > 0.0).all()
    np.testing.assert_array_equal(enlarge_depth(depth, 8, 6), depth)


@pytest.mark.parametrize("distortion", [(), BENT])
@pytest.mark.parametrize("moved", [False, True])
def test_depth_of_a_camera_of_its_own(distortion: tuple[float, ...], moved: bool) -> None:
    T = se3.se3_exp([0.05, -0.01, 0.004, 0.01, -0.02, 0.005]) if moved else np.eye(4)
    rig = Rig(Lens(COLOUR), depth=Lens(DEPTH, distortion), T_colour_depth=T if moved else None)
    got = rig.depth(seen_by(DEPTH, T, distortion))
    want = seen_by(COLOUR, np.eye(4))
    reading = got > 0.0
    rows, columns = np.mgrid[:120, :160]
    inside = (rows > 12) & (rows < 108) & (columns > 16) & (columns < 144)
    far = away_from_edges(want, 4) & inside
    assert reading[far].mean() > 0.999
    assert np.abs(got - want)[far & reading].max() < 0.02
    between = (got > 1.6) & (got < 2.0)
    assert not between.any()


def test_registration_takes_the_nearest_surface() -> None:
    """A camera to the left sees behind the box what the colour camera does not."""
    T = se3.se3_exp([-0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    camera = COLOUR.scaled(2.0)
    got = Rig(Lens(COLOUR), depth=Lens(camera), T_colour_depth=T).depth(seen_by(camera, T))
    want = seen_by(COLOUR, np.eye(4))
    reading = got > 0.0
    box = want < 1.5
    assert np.abs(got - want)[box & reading & away_from_edges(want, 1)].max() < 0.01
    assert (got[reading & ~box & away_from_edges(want, 1)] > 2.0).all()


def test_depth_bent_as_colour_is_straightened_with_it() -> None:
    straight = seen_by(COLOUR, np.eye(4))
    bent = seen_by(COLOUR, np.eye(4), BENT)
    far = away_from_edges(straight, 4)
    got = Rig(Lens(COLOUR, BENT), depth_distorted=True).depth(bent)
    assert np.abs(got - straight)[far & (got > 0.0)].max() < 5e-3 and (got[far] > 0.0).mean() > 0.9
    left = Rig(Lens(COLOUR, BENT)).depth(straight)
    np.testing.assert_array_equal(left[left > 0.0], straight[left > 0.0])


def test_intrinsics_that_change_bring_the_picture_to_the_first_camera() -> None:
    zoomed = Camera(160, 120, 150.0, 151.0, 82.0, 57.0)
    depth = seen_by(zoomed, np.eye(4))
    rgb = np.repeat((depth * 60).astype(np.uint8)[..., None], 3, axis=2)
    rig = Rig(Lens(COLOUR))
    want = seen_by(COLOUR, np.eye(4))
    far = away_from_edges(want, 4)
    got = rig.depth(seen_by(zoomed.resized(80, 60), np.eye(4)), zoomed)
    assert np.abs(got - want)[far & (got > 0)].max() < 0.02 and (got[far] > 0).mean() > 0.8
    seen = rig.colour(rgb, zoomed)[..., 0]
    inner = np.s_[12:-12, 12:-12]
    assert np.abs(seen - want * 60)[inner][far[inner]].max() < 2.0
    labels = rig.labels((depth < 1.5).astype(np.int32), zoomed)
    assert labels is not None
    np.testing.assert_array_equal(labels[far & (got > 0)] > 0, (want < 1.5)[far & (got > 0)])


@pytest.fixture
def recording(tmp_path: Path, sample: SimpleNamespace) -> Callable[..., Path]:
    def make(pose: np.ndarray = ORIGIN, **camera: object) -> Path:
        for i in range(2):
            sample.save(tmp_path / f"color/{i}.png", np.full((120, 160, 3), 90, np.uint8))
            raw = np.rint(seen_by(DEPTH, pose) * 1000).astype(np.uint16)
            sample.save(tmp_path / f"depth/{i}.png", raw)
        names = {"w": "width", "h": "height", "fx": "fx", "fy": "fy", "cx": "cx", "cy": "cy"}
        values = {key: getattr(COLOUR, name) for key, name in names.items()}
        own = {key: getattr(DEPTH, name) for key, name in names.items()}
        (tmp_path / "camera.json").write_text(json.dumps(values | {"scale": 1000, "depth": own} | camera))
        return tmp_path

    return make


def test_a_camera_file_gives_the_depth_camera_and_where_it_is(recording: Callable[..., Path]) -> None:
    T = se3.se3_exp([0.05, 0.0, 0.0, 0.0, 0.01, 0.0])
    folder = recording(T, T_color_depth=T.tolist())
    depth = open_dataset(str(folder), data_root=folder)[0].depth
    want = seen_by(COLOUR, np.eye(4))
    assert depth is not None and depth.shape == (120, 160)
    good = (depth > 0) & away_from_edges(want, 4)
    assert np.abs(depth - want)[good].max() < 0.02 and good.mean() > 0.4


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"T_color_depth": [1, 2, 3]}, "T_color_depth is .* expected a rigid motion"),
        ({"T_color_depth": (2 * np.eye(4)).tolist()}, "T_color_depth is .* expected a rigid motion"),
        ({"depth": {"w": 80, "h": 66}}, "fx is missing"),
        ({"depth": 5000}, "depth is 5000; expected such as"),
        ({"depth_distorted": "yes"}, "depth_distorted is 'yes'; it must be true or false"),
    ],
)
def test_a_wrong_camera_file_is_refused(recording: Callable[..., Path], wrong: dict, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        open_dataset(str(recording(**wrong)), data_root=Path())


@pytest.mark.parametrize("bent", [False, True])
def test_edges_tell_whether_depth_is_bent_as_colour(
    tmp_path: Path, sample: SimpleNamespace, bent: bool
) -> None:
    lens = (0.25, -0.15, 0.001, -0.001, 0.02)
    camera = room.COLOUR.resized(240, 180)
    K = camera.matrix
    grid = np.stack(np.meshgrid(np.arange(240.0), np.arange(180.0)), -1).astype(np.float32)
    ideal = cv2.undistortPoints(grid.reshape(-1, 1, 2), K, np.array(lens), P=K).reshape(180, 240, 2)
    u, v = ideal[..., 0].astype(np.float32), ideal[..., 1].astype(np.float32)
    for i in range(4):
        rgb, depth = room.look(camera, straight(i))
        rgb[depth < 1.9] //= 2  # the box is darker than the walls
        seen = cv2.remap(depth, u, v, cv2.INTER_NEAREST) if bent else depth
        sample.save(tmp_path / f"color/{i}.png", cv2.remap(rgb, u, v, cv2.INTER_LINEAR))
        sample.save(tmp_path / f"depth/{i}.png", room.millimetres(seen))
    values = dict(w=240, h=180, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
    (tmp_path / "camera.json").write_text(json.dumps(values | {"distortion": lens}))
    dataset = open_dataset(str(tmp_path), data_root=tmp_path)
    got, want = dataset[1].depth, room.look(camera, straight(1))[1]
    assert got is not None and np.median(np.abs(got - want)[got > 0]) < 2e-3
    assert ("bent as the colour is" in source_of(dataset).depth_unit) == bent
    told = json.dumps(values | {"distortion": lens, "depth_distorted": not bent})
    (tmp_path / "camera.json").write_text(told)
    other = open_dataset(str(tmp_path), data_root=tmp_path)[1].depth
    assert other is not None and not np.array_equal(other, got), "the file's word goes first"


@pytest.mark.parametrize("size", [(160, 120), (40, 30)])
@pytest.mark.parametrize(
    ("rig", "camera"),
    [
        (Rig(Lens(COLOUR)), None),
        (Rig(Lens(COLOUR, BENT)), None),
        (Rig(Lens(COLOUR, BENT), depth_distorted=True), None),
        (Rig(Lens(COLOUR)), Camera(160, 120, 150.0, 151.0, 78.0, 61.0)),
    ],
    ids=["as it is", "bent colour", "bent depth", "another focal length"],
)
def test_weights_stay_with_their_readings(rig: Rig, camera: Camera | None, size: tuple[int, int]) -> None:
    """Surfaces at 1 m count half, at 2 m fully: wherever a reading goes, its weight is there."""
    v, u = np.mgrid[: size[1], : size[0]]
    depth = np.where((u // (size[0] // 5) + v // (size[1] // 5)) % 2 == 0, 1.0, 2.0).astype(np.float32)
    got, weights = rig.depth(depth, camera), rig.weights(depth / 2.0, camera)
    assert weights is not None and weights.shape == got.shape and weights.dtype == np.float32
    read = (got > 0.0) & (weights > 0.0)
    assert read.sum() > 0.9 * (got > 0.0).sum()
    assert np.mean(weights[read] == np.rint(got[read]) / 2.0) > 0.99


def test_registered_readings_have_no_weights() -> None:
    assert Rig(Lens(COLOUR), depth=Lens(DEPTH)).weights(np.ones((66, 80), np.float32)) is None
