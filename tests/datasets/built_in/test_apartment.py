# SPDX-License-Identifier: Apache-2.0
"""The built-in apartment: a walk through rooms that hold together, and a person in them."""

from concurrent.futures import ThreadPoolExecutor
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pytest

from ggwarp.datasets import APARTMENTS, Dataset, DatasetError, open_dataset
from ggwarp.datasets.base import at_scale
from ggwarp.datasets.built_in.apartment import KINECT_FAULTS, SyntheticApartment
from ggwarp.datasets.built_in.apartment_plan import HEIGHT, ROOMS, apartment_scene
from ggwarp.datasets.built_in.apartment_walk import AGAIN, person_at, way_points
from ggwarp.datasets.built_in.faults import SensorFaults
from ggwarp.geometry.se3 import inverse, so3_log
from ggwarp.kernels.scene import primitives as prims

SCALE = 0.125


@pytest.fixture(scope="module")
def apartment() -> SyntheticApartment:
    return SyntheticApartment(scale=SCALE)


@pytest.fixture(scope="module")
def views(apartment: SyntheticApartment) -> list:
    """Every eightieth frame."""
    return [apartment[i] for i in range(0, len(apartment), 80)]


def _same(a, b) -> bool:
    return all(np.array_equal(getattr(a, k), getattr(b, k)) for k in ("rgb", "depth", "mask", "T_wc"))


@pytest.mark.parametrize("name", APARTMENTS)
def test_each_is_opened_by_its_name(name):
    dataset = open_dataset(name, data_root=Path("nowhere"))
    assert isinstance(dataset, Dataset) and dataset.name == name and len(dataset) == 2400
    assert (dataset.camera.width, dataset.camera.height) == (640, 480)
    assert ("person" in dataset.class_names.values()) == ("person" in name)
    small = at_scale(dataset, 0.05)[0]
    assert small.depth.shape == (24, 32) == small.mask.shape


def test_a_frame_depends_on_its_index_alone():
    options = {"scale": SCALE, "kinect": True, "person": True}
    one, other = SyntheticApartment(**options), SyntheticApartment(**options)
    order = [880, 20, 2399, 880]
    with ThreadPoolExecutor(3) as pool:
        frames = list(pool.map(one.__getitem__, order))
    assert all(_same(frame, other[i]) for i, frame in zip(order, frames, strict=True))


def test_the_walk_is_one_of_a_person(apartment):
    steps = np.array([inverse(a) @ b for a, b in pairwise(apartment.trajectory)])
    speed = np.linalg.norm(steps[:, :3, 3], axis=1) * 30.0
    turn = np.degrees([np.linalg.norm(so3_log(T[:3, :3])) for T in steps]) * 30.0
    assert speed.max() < 1.0 and turn.max() < 60.0, "metres and degrees a second"
    assert speed.sum() / 30.0 > 20.0, "metres in all"
    moves = np.diff(apartment.trajectory[:, :3, 3], axis=0) * 30.0
    assert np.linalg.norm(np.diff(moves, axis=0), axis=1).max() * 30.0 < 2.0, "metres a second squared"


def test_it_goes_through_every_room_and_back(apartment):
    def room_of(at) -> str | None:
        return next((n for n, r in ROOMS.items() if np.all(at > r.low) and np.all(at < r.high)), None)

    visited = [room_of(T[:2, 3]) for T in apartment.trajectory]
    order = [name for name, _ in groupby(name for name in visited if name)]
    assert order == ["living room", "kitchen", "corridor", "bedroom", "study", "corridor", "living room"]


def test_the_end_looks_at_the_start_again(apartment):
    places = way_points(len(apartment))
    once = places[-1] - AGAIN
    again = np.flatnonzero(places >= once)
    assert again.size > 60
    seen = np.interp(places[again] - once, places, np.arange(len(places))).round().astype(int)
    for k, first in zip(again[::20], seen[::20], strict=True):
        T = inverse(apartment.trajectory[first]) @ apartment.trajectory[k]
        assert np.linalg.norm(T[:3, 3]) < 0.05 and np.linalg.norm(so3_log(T[:3, :3])) < np.radians(3.0)
    both = [apartment[int(k)].mask for k in (seen[-1], again[-1])]
    assert len(np.intersect1d(*both)) > 0.8 * len(np.unique(both[0]))


def test_the_camera_keeps_clear_of_everything(apartment):
    at = apartment.trajectory[::10, :3, 3]
    assert np.all((at[:, 2] > 1.3) & (at[:, 2] < HEIGHT - 0.8))
    for shape in apartment_scene().shapes:
        thick = np.array([1.0, 1.0, 0.0]) if shape.kind == prims.RECTANGLE else 1.0
        half = shape.size * np.array([max(1.0, shape.taper)] * 2 + [1.0]) * thick
        local = (at - shape.centre) @ shape.rotation
        assert np.linalg.norm(np.maximum(np.abs(local) - half, 0.0), axis=1).min() > 0.2, shape


def test_rooms_are_closed_lit_and_full_of_things(apartment, views):
    for frame in views:
        assert frame.depth.min() > 0.2 and frame.depth.max() < 9.0
        assert frame.mask.min() >= 1 and frame.mask.max() <= len(apartment.class_names)
        assert 60 < frame.rgb.mean() < 200 and np.mean(frame.rgb == 255) < 0.1
    seen = {apartment.class_names[i] for f in views for i in np.unique(f.mask)}
    assert len(seen) > 50 and {"bed", "fridge", "sofa", "desk", "front door"} <= seen


@pytest.mark.parametrize("i", [0, 640, 1500])
def test_depth_and_poses_agree(i):
    """Points of one frame, moved into a later one, lie on what that one sees, but for what it hides."""
    apartment = SyntheticApartment(scale=0.25)
    a, b, c = apartment[i], apartment[i + 12], apartment.camera
    v, u = np.mgrid[0 : c.height, 0 : c.width]
    points = np.stack([(u - c.cx) / c.fx, (v - c.cy) / c.fy, np.ones(u.shape)], -1) * a.depth[..., None]
    T = inverse(b.T_wc) @ a.T_wc
    moved = points.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    x, y = moved[:, 0] / moved[:, 2] * c.fx + c.cx, moved[:, 1] / moved[:, 2] * c.fy + c.cy
    inside = (x > 0) & (x < c.width - 1.001) & (y > 0) & (y < c.height - 1.001) & (moved[:, 2] > 0)
    x, y, z, ids = x[inside], y[inside], moved[inside, 2], a.mask.ravel()[inside]
    j, k = np.floor(y).astype(int), np.floor(x).astype(int)
    corners = [(j, k), (j, k + 1), (j + 1, k), (j + 1, k + 1)]
    inverses = np.array([1.0 / b.depth[r, s] for r, s in corners])
    same = np.all([b.mask[r, s] == ids for r, s in corners], axis=0)
    flat = np.abs(inverses[0] + inverses[3] - inverses[1] - inverses[2]) < 2e-5
    fx, fy = x - k, y - j
    weights = np.array([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    error = np.abs(1.0 / np.sum(weights * inverses, axis=0) - z)[same & flat]
    assert error.size > 0.4 * np.count_nonzero(inside)
    assert np.median(error) < 1e-4 and np.mean(error < 1e-3) > 0.95


def test_someone_walks_through_and_nothing_else_changes(apartment):
    busy = SyntheticApartment(scale=SCALE, person=True)
    person = len(busy.class_names)
    assert busy.class_names[person] == "person" and person in busy.ids
    shares = []
    for i in (24, 880, 1490):
        frame, empty = busy[i], apartment[i]
        there = frame.mask == person
        shares.append(there.mean())
        assert np.all(frame.depth[there] < empty.depth[there])
        edge = np.zeros_like(there)
        for dv in (-1, 0, 1):
            for du in (-1, 0, 1):
                edge |= np.roll(there, (dv, du), (0, 1))
        assert np.array_equal(frame.rgb[~edge], empty.rgb[~edge])
        assert np.array_equal(frame.depth[~there], empty.depth[~there])
    assert min(shares) > 0.005 and max(shares) > 0.1
    assert _same(busy[1200], apartment[1200]), "nobody there"


def test_the_person_walks_at_a_walk():
    times = way_points(2400)
    places = [person_at(t) for t in times]
    for k in range(len(times) - 1):
        if places[k] and places[k + 1] and places[k + 1][2] > places[k][2]:
            assert np.linalg.norm(places[k + 1][0] - places[k][0]) * 30.0 < 1.6
    assert sum(place is not None for place in places) > 200 and places[-1] is None


def test_what_the_user_says_of_the_sensor_holds():
    quiet = SyntheticApartment(kinect=True, faults=SensorFaults(exposure_drift=0.05, seed=4))
    assert quiet.faults.exposure_drift == 0.05 and quiet.faults.seed == 4
    assert quiet.faults.colour_noise == KINECT_FAULTS.colour_noise
    assert SyntheticApartment().faults == SensorFaults()


def test_no_frames_are_refused():
    with pytest.raises(DatasetError, match="0 frames"):
        SyntheticApartment(frames=0)
