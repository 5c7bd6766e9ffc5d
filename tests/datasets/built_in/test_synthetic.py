# SPDX-License-Identifier: Apache-2.0
"""The built-in office: truth that holds together, and faults that do what they say."""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest

from ggwarp.datasets import Dataset, DatasetError, SyntheticOffice
from ggwarp.datasets.built_in.faults import MaskFaults, SensorFaults, quantised_depth
from ggwarp.datasets.built_in.office import HEIGHT, LENGTH, STRUCTURE, WIDTH, build_office
from ggwarp.datasets.built_in.synthetic import SyntheticWall
from ggwarp.geometry.se3 import inverse, so3_log
from ggwarp.kernels.scene import primitives as prims

SCALE = 0.1


@pytest.fixture(scope="module")
def office() -> SyntheticOffice:
    return SyntheticOffice(scale=SCALE)


@pytest.fixture(scope="module")
def views(office: SyntheticOffice) -> list:
    """Every fourth frame."""
    return [office[i] for i in range(0, len(office), 4)]


def _same(a, b) -> bool:
    return all(np.array_equal(getattr(a, k), getattr(b, k)) for k in ("rgb", "depth", "mask", "T_wc"))


def test_it_is_a_dataset(office):
    assert isinstance(office, Dataset)
    frame = office[3]
    assert (office.camera.width, office.camera.height, office.camera.fx) == (120, 68, 60.0)
    assert frame.rgb.shape == (68, 120, 3) and frame.rgb.dtype == np.uint8
    assert frame.depth.shape == (68, 120) and frame.depth.dtype == np.float32
    assert frame.mask.shape == (68, 120) and frame.mask.dtype == np.int32
    assert frame.index == 3 and frame.timestamp == pytest.approx(0.1)


def test_a_frame_depends_on_its_index_alone(office):
    again = SyntheticOffice(scale=SCALE)
    order = [7, 0, 119, 7]
    with ThreadPoolExecutor(3) as pool:
        frames = list(pool.map(again.__getitem__, order))
    assert all(_same(frame, office[i]) for i, frame in zip(order, frames, strict=True))


def test_faults_do_not_depend_on_the_order_of_access():
    options = {
        "scale": SCALE,
        "faults": SensorFaults(0.002, 5.0, 0.125, colour_noise=3.0, exposure_drift=0.1),
        "mask_faults": MaskFaults(0.02, 2, 1.5, 0.1, 0.1, True),
    }
    a, b = SyntheticOffice(**options), SyntheticOffice(**options)
    first = [a[i] for i in (2, 9)]
    assert _same(b[9], first[1]) and _same(b[2], first[0])
    assert not np.array_equal(first[0].mask, SyntheticOffice(scale=SCALE)[2].mask)


def test_every_pixel_has_depth_an_object_and_a_lit_colour(office, views):
    for frame in views:
        assert frame.depth.min() > 0.5 and frame.depth.max() < np.hypot(LENGTH, WIDTH)
        assert frame.mask.min() >= 1 and frame.mask.max() <= len(office.class_names) <= 60
        assert 60 < frame.rgb.mean() < 190
        assert np.mean(frame.rgb == 255) < 0.03


def test_objects_are_many_and_seen_often(office, views):
    pixels = {i: [int(np.sum(f.mask == i)) for f in views] for i in office.class_names if i > len(STRUCTURE)}
    assert len(pixels) >= 40
    seen = [i for i, counts in pixels.items() if sum(c >= 10 for c in counts) >= 3]
    assert len(seen) >= 30
    assert len({office.class_names[i] for i in seen}) >= 20


def test_the_loop_closes_and_moves_gently(office):
    poses = office.trajectory
    assert np.allclose(poses[0], poses[-1], atol=1e-12)
    steps = np.array([inverse(a) @ b for a, b in pairwise(poses)])
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.04
    assert np.degrees([np.linalg.norm(so3_log(T[:3, :3])) for T in steps]).max() < 4.0
    headings = np.unwrap(np.arctan2(poses[:, 1, 2], poses[:, 0, 2]))
    assert headings[-1] - headings[0] == pytest.approx(2 * np.pi)


@pytest.mark.parametrize("bare", [False, True])
def test_the_camera_keeps_clear_of_everything(bare):
    poses = SyntheticOffice(frames=200, featureless_wall=bare).trajectory
    shapes, _ = build_office(featureless_wall=bare)
    at = poses[:, :3, 3]
    assert np.all(np.abs(at[:, :2]) < np.array([LENGTH, WIDTH]) / 2 - 0.4)
    assert np.all((at[:, 2] > 1.0) & (at[:, 2] < HEIGHT - 0.8))
    for shape in shapes:
        if shape.kind == prims.RECTANGLE:
            continue
        # Bounds along the shape's own axes hold every kind of shape.
        half = shape.size * np.array([max(1.0, shape.taper)] * 2 + [1.0])
        local = (at - shape.centre) @ shape.rotation
        gap = np.linalg.norm(np.maximum(np.abs(local) - half, 0.0), axis=1)
        assert gap.min() > 0.2


@pytest.mark.parametrize("i", [0, 33, 90])
def test_depth_and_poses_agree(i):
    """A point of one frame is seen at its depth by the next: inverse depth is linear on planes."""
    office = SyntheticOffice(scale=0.25)
    a, b, c = office[i], office[i + 1], office.camera
    v, u = np.mgrid[0 : c.height, 0 : c.width]
    points = np.stack([(u - c.cx) / c.fx * a.depth, (v - c.cy) / c.fy * a.depth, a.depth], -1).reshape(-1, 3)
    T = inverse(b.T_wc) @ a.T_wc
    moved = points @ T[:3, :3].T + T[:3, 3]
    x, y = moved[:, 0] / moved[:, 2] * c.fx + c.cx, moved[:, 1] / moved[:, 2] * c.fy + c.cy
    inside = (x > 0) & (x < c.width - 1.001) & (y > 0) & (y < c.height - 1.001)
    x, y, z, ids = x[inside], y[inside], moved[inside, 2], a.mask.ravel()[inside]
    j, k = np.floor(y).astype(int), np.floor(x).astype(int)
    corners = [(j, k), (j, k + 1), (j + 1, k), (j + 1, k + 1)]
    inverses = np.array([1.0 / b.depth[r, s] for r, s in corners])
    same = np.all([b.mask[r, s] == ids for r, s in corners], axis=0)
    # Away from creases and occlusions: the four corners lie on one plane.
    flat = np.abs(inverses[0] + inverses[3] - inverses[1] - inverses[2]) < 2e-5
    fx, fy = x - k, y - j
    weights = np.array([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    error = np.abs(1.0 / np.sum(weights * inverses, axis=0) - z)[same & flat]
    assert error.size > 0.5 * inside.size
    assert np.percentile(error, 97) < 1e-4
    assert np.mean(error < 1e-3) > 0.97


def test_scales_see_the_same_room(office):
    """Depth is exact at pixel centres: a third of the size has every third pixel."""
    big, small = SyntheticOffice(scale=0.3)[5], office[5]
    assert np.mean(np.abs(big.depth[1::3, 1::3] - small.depth) < 1e-4) > 0.999
    assert np.mean(big.mask[1::3, 1::3] == small.mask) > 0.999
    mean = big.rgb.reshape(68, 3, 120, 3, 3).mean((1, 3))
    assert np.sqrt(np.mean((mean - small.rgb) ** 2)) < 9.0
    assert _same(office.scaled(3.0)[5], big)


def test_objects_left_out_change_nothing_else(office):
    chair = next(i for i, name in office.class_names.items() if name == "office chair")
    i = 49
    with_chair, without = office[i], SyntheticOffice(scale=SCALE, without=(chair,))[i]
    assert np.sum(with_chair.mask == chair) > 50 and not np.any(without.mask == chair)
    near = np.zeros_like(with_chair.mask, bool)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            near |= np.roll(with_chair.mask == chair, (dv, du), (0, 1))
    assert np.array_equal(with_chair.rgb[~near], without.rgb[~near])
    assert np.all(without.depth[with_chair.mask == chair] > with_chair.depth[with_chair.mask == chair])


def test_shadows_go_with_what_casts_them(office):
    chair = next(i for i, name in office.class_names.items() if name == "office chair")
    kept = SyntheticOffice(scale=SCALE, without=(chair,))[49]
    gone = SyntheticOffice(scale=SCALE, without=(chair,), shade_goes=True)[49]
    np.testing.assert_array_equal(kept.depth, gone.depth)
    brighter = gone.rgb.astype(int).mean(axis=2) - kept.rgb.astype(int).mean(axis=2)
    assert (brighter > 10.0).mean() > 0.02 and (brighter < -2.0).mean() < 0.001
    assert _same(SyntheticOffice(scale=SCALE, shade_goes=True)[49], office[49])


def test_the_bare_wall_fills_a_view():
    office = SyntheticOffice(scale=SCALE, featureless_wall=True)
    wall = next(k for k, name in office.class_names.items() if name == "north wall")
    shares = [np.mean(office[i].mask == wall) for i in range(0, len(office), 2)]
    assert max(shares) == 1.0
    frame = office[2 * int(np.argmax(shares))]
    # Paint without a pattern under soft light: nothing but a slow gradient.
    assert np.abs(np.diff(frame.rgb.astype(int), axis=1)).max() < 10


def test_the_wall_is_all_there_is_and_a_plane():
    wall = SyntheticWall(scale=SCALE)
    assert len(wall) == 60 and wall.name == "wall" and wall.class_names == {1: "wall"}
    camera = wall.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    for frame in (wall[i] for i in range(0, 60, 6)):
        assert np.all(frame.mask == 1)
        points = (rays * frame.depth[..., None]) @ frame.T_wc[:3, :3].T + frame.T_wc[:3, 3]
        assert np.ptp(points[..., 1]) < 1e-4, "no relief that would hold a registration of depth"
        assert frame.rgb.std(axis=(0, 1)).min() > 20.0, "but a print to see"
    steps = np.array([inverse(a) @ b for a, b in pairwise(wall.trajectory)])
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 0.045
    assert np.degrees([np.linalg.norm(so3_log(T[:3, :3])) for T in steps]).max() < 1.0
    moves = np.diff(wall.trajectory[:, :3, 3], axis=0)
    assert np.linalg.norm(np.diff(moves, axis=0), axis=1).max() > 0.003, "its speed changes"


@pytest.mark.parametrize(
    "options, message",
    [
        ({"frames": 0}, "0 frames"),
        ({"scale": 0.0}, "scale 0"),
        ({"scale": float("nan")}, "scale nan"),
        ({"without": (999,)}, "999"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(DatasetError, match=message):
        SyntheticOffice(**options)


@pytest.mark.parametrize("i", [-1, 120])
def test_indices_outside_raise(office, i):
    with pytest.raises(IndexError):
        office[i]


def test_depth_noise_grows_with_the_square_of_depth(office):
    noisy = SyntheticOffice(scale=SCALE, faults=SensorFaults(depth_noise=0.002))
    z = np.concatenate([office[i].depth.ravel() for i in range(0, 120, 10)])
    e = np.concatenate([noisy[i].depth.ravel() for i in range(0, 120, 10)]) - z
    for low, high in ((1.0, 2.0), (2.0, 3.0), (3.0, 4.0)):
        part = (z > low) & (z < high)
        assert np.std(e[part] / z[part] ** 2) == pytest.approx(0.002, rel=0.05)
    assert abs(np.mean(e)) < 1e-3


def test_depth_comes_in_steps_of_disparity(office):
    depth = SyntheticOffice(scale=SCALE, faults=SensorFaults(disparity_step=0.125))[0].depth
    steps = 43.5 / depth / 0.125
    assert np.allclose(steps, np.round(steps), atol=1e-3)
    assert np.abs(depth - office[0].depth).max() < 0.51 * 0.125 / 43.5 * depth.max() ** 2 * 1.1
    assert not quantised_depth(np.array([[0.0, 1e4]], np.float32), 0.125, 43.5).any()


def test_holes_lie_where_surfaces_are_seen_edge_on(office):
    depth = SyntheticOffice(scale=SCALE, faults=SensorFaults(grazing_holes=10.0))[20].depth
    holes = depth == 0
    assert 0.005 < holes.mean() < 0.25
    true = office[20].depth
    assert np.array_equal(depth[~holes], true[~holes])
    jumps = np.abs(np.diff(true, axis=1)) > 0.5
    assert np.all(holes[:, 1:][jumps]) and np.all(holes[:, :-1][jumps])


def test_colour_noise_and_exposure(office):
    noise = SyntheticOffice(scale=SCALE, faults=SensorFaults(colour_noise=4.0))[10]
    middle = (office[10].rgb > 30) & (office[10].rgb < 225)
    assert np.std((noise.rgb.astype(float) - office[10].rgb)[middle]) == pytest.approx(4.0, rel=0.05)
    drift = SyntheticOffice(scale=SCALE, faults=SensorFaults(exposure_drift=0.2))
    gains = [drift[i].rgb.mean() / office[i].rgb.mean() for i in (0, 30, 60, 89)]
    assert gains[0] == 1.0 and gains[1] > 1.1 and abs(gains[2] - 1.0) < 0.02 and gains[3] < 0.85
    faster = SyntheticOffice(scale=SCALE, faults=SensorFaults(exposure_drift=0.2, exposure_swings=2.0))
    assert faster[45].rgb.mean() / office[45].rgb.mean() < 0.85


def test_faults_leave_the_true_mask_alone(views) -> None:
    broken = SyntheticOffice(scale=SCALE, mask_faults=MaskFaults(0.02, 2, 1.5, 0.1, 0.1, True))[0]
    np.testing.assert_array_equal(broken.true_mask, views[0].mask)
    np.testing.assert_array_equal(views[0].true_mask, views[0].mask)
    assert not np.array_equal(broken.mask, broken.true_mask)


def _masks(**options) -> list:
    broken = SyntheticOffice(scale=SCALE, mask_faults=MaskFaults(**options))
    return [broken[i].mask for i in range(0, 120, 4)]


def test_dots_cover_their_share(views):
    wrong = [np.mean(m != f.mask) for m, f in zip(_masks(dots=0.05), views, strict=True)]
    assert np.mean(wrong) == pytest.approx(0.05, rel=0.12)


def test_ragged_edges_stay_near_edges(views):
    for mask, frame in zip(_masks(ragged=2.0)[:5], views, strict=False):
        wrong = mask != frame.mask
        near = np.zeros_like(wrong)
        for dv in range(-2, 3):
            for du in range(-2, 3):
                near |= np.roll(frame.mask, (dv, du), (0, 1)) != frame.mask
        near[:2], near[-2:], near[:, :2], near[:, -2:] = True, True, True, True
        assert 0.005 < wrong.mean() and not np.any(wrong & ~near)


def test_dropped_and_swapped_object_frames(views):
    total = dropped = swapped = 0
    for gone, moved, frame in zip(_masks(dropped=0.2), _masks(swapped=0.2), views, strict=True):
        for k in np.unique(frame.mask):
            here = frame.mask == k
            total += 1
            dropped += np.all(gone[here] == 0)
            swapped += np.all(moved[here] != k)
            assert len(np.unique(moved[here])) == 1
    assert dropped / total == pytest.approx(0.2, abs=0.05)
    assert swapped / total == pytest.approx(0.2, abs=0.05)


def test_a_share_of_the_frames_has_no_mask():
    gone = [m is None for m in _masks(missing=0.3)]
    assert gone == [m is None for m in _masks(missing=0.3, dots=0.1)]
    assert 3 <= sum(gone) <= 15


def test_shuffled_ids_keep_the_regions(views):
    masks = _masks(shuffled=True)
    assert not np.array_equal(masks[0], views[0].mask)
    for mask, frame in zip(masks, views, strict=True):
        pairs = np.unique(np.stack([mask.ravel(), frame.mask.ravel()]), axis=1)
        assert pairs.shape[1] == len(np.unique(frame.mask)) == len(np.unique(mask))
