# SPDX-License-Identifier: Apache-2.0
"""Submaps against a map that is whole: the same Gaussians, the same views."""

from pathlib import Path

import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.map.gaussians import Gaussians, join
from ggwarp.map.renderer import Renderer
from ggwarp.map.submap import MapBudget
from ggwarp.map.submaps import Submaps
from ggwarp.runtime.streams import to_host

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
TURNS = [np.eye(4), *(se3.se3_exp([0.0, 0.0, 0.0, 0.0, k * np.pi / 2, 0.0]) for k in (1, 2, 3))]
"""Four views from the middle of a room, of one wall each."""
DEPTH = np.full((48, 64), 2.0, np.float32)


def wall(T_wc: np.ndarray, keyframe: int, rng: np.random.Generator) -> Gaussians:
    """Return what the view at ``T_wc`` sees: a wall two metres away, and all else of a Gaussian at random."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 24), np.linspace(-0.7, 0.7, 18))
    points = np.stack([x, y, np.full_like(x, 2.0)], -1).reshape(-1, 3)
    n = len(points)
    return Gaussians(
        se3.transform_points(T_wc, points).astype(np.float32),
        rng.normal(size=(n, 4)).astype(np.float32),
        rng.normal(np.log(0.04), 0.1, (n, 3)).astype(np.float32),
        rng.normal(2.0, 0.5, n).astype(np.float32),
        rng.normal(size=(n, 3)).astype(np.float32),
        identities=rng.normal(size=(n, 16)).astype(np.float32),
        keyframe_ids=np.full(n, keyframe, np.int32),
        votes=rng.integers(0, 9, n).astype(np.int32),
    )


def room(device: str, budget: MapBudget | None, rng: np.random.Generator) -> tuple[GaussianMap, Submaps]:
    """Return a map of four keyframes, with moments and statistics of all Gaussians."""
    gaussians = GaussianMap(device=device, has_identity=True, capacity=64)
    submaps = Submaps(gaussians, CAMERA, budget)
    for keyframe, T_wc in enumerate(TURNS):
        submaps.show(T_wc, DEPTH)
        submaps.add(T_wc, DEPTH)
        new = wall(T_wc, keyframe, rng)
        gaussians.append(new)
        for name in ("first", "second", "first_identity", "second_identity", "steps", "low_weight_counts"):
            values = to_host(gaussians.fields[name]).copy()
            end = gaussians.count
            shape = values[end - len(new) : end].shape
            values[end - len(new) : end] = rng.integers(1, 99, shape)
            gaussians.fields[name].assign(values)
    return gaussians, submaps


def assert_same_map(one: Submaps, other: Submaps) -> None:
    """Check all fields of all of the map, whatever is parked, and in whatever order."""
    rows = []
    for submaps in (one, other):
        parts = [{n: to_host(a)[: part.count] for n, a in part.fields.items()} for part in submaps.parts()]
        fields = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        order = np.argsort(fields["identities"][:, 0])  # no two are alike, and nothing moves them
        rows.append({name: values[order] for name, values in fields.items()})
    for name, values in rows[0].items():
        np.testing.assert_array_equal(values, rows[1][name], err_msg=name)


def test_what_is_parked_and_comes_back_keeps_every_bit(device: str, tmp_path: Path) -> None:
    whole, submaps = room(device, None, np.random.default_rng(3))[1], None
    budget = MapBudget(0, lambda: tmp_path)
    gaussians, submaps = room(device, budget, np.random.default_rng(3))

    submaps.show(TURNS[0], DEPTH)

    assert submaps.parked == [1, 2] and gaussians.count == submaps.count // 2, "but the newest keyframe's"
    assert submaps.count == whole.count and whole.parked == []
    assert_same_map(submaps, whole)
    for turn in (2, 1, 3, 0):
        submaps.show(TURNS[turn], DEPTH)
        assert turn not in submaps.parked and len(submaps.parked) >= 2 and 3 not in submaps.parked
    assert_same_map(submaps, whole)
    assert list(tmp_path.iterdir()) == [], "the file has no name"


def test_only_what_the_budget_has_no_room_for_is_parked(device: str) -> None:
    budgets = [None, MapBudget(1 << 30), MapBudget(2_000_000), MapBudget(0)]
    parked: list[list[int]] = []
    for budget in budgets:
        gaussians, submaps = room(device, budget, np.random.default_rng(3))
        submaps.show(TURNS[3], DEPTH)
        parked.append(submaps.parked)
        if budget is not None and submaps.parked:
            assert budget.size == 0 or 1.5 * gaussians.count * gaussians.row_bytes < budget.size
    assert parked == [[], [], [0, 1], [0, 1, 2]], "those that were in view longest ago go first"


@pytest.mark.parametrize("angle", [0.0, 0.4, 0.8, 2.2, 4.0])
def test_a_view_shows_what_it_shows_of_a_whole_map(angle: float, device: str) -> None:
    """Also where several submaps meet in it: no seam."""
    T_wc = se3.se3_exp([0.1, 0.0, -0.2, 0.0, angle, 0.0])
    pictures = []
    for budget in (None, MapBudget(0)):
        gaussians, submaps = room(device, budget, np.random.default_rng(3))
        submaps.show(T_wc)
        renderer = Renderer(gaussians, CAMERA)
        renderer.render(T_wc)
        pictures.append((renderer.picture(), renderer.identity()))
    (one, identity), (other, others) = pictures
    assert one.opacity.max() > 0.9
    np.testing.assert_allclose(other.rgb, one.rgb, atol=1e-5)
    np.testing.assert_allclose(other.depth, one.depth, atol=1e-4)
    np.testing.assert_allclose(others, identity, atol=1e-4)


def test_loops_move_what_is_parked(device: str) -> None:
    """Twice, and some keyframes farther than others."""
    rng = np.random.default_rng(5)
    _, whole = room(device, None, np.random.default_rng(3))
    _, submaps = room(device, MapBudget(0), np.random.default_rng(3))
    submaps.show(TURNS[0], DEPTH)
    poses = np.stack(TURNS)
    for _ in range(2):
        motions = np.stack([np.eye(4), *(se3.se3_exp(rng.normal(0.0, 0.3, 6)) for _ in range(3))])
        poses = motions @ poses
        for each in (whole, submaps):
            each.move(motions)
    assert submaps.parked == [1, 2]

    assert_same_map(submaps, whole)
    for turn in range(4):
        submaps.show(poses[turn], DEPTH)
        assert turn not in submaps.parked, "it is looked for where it is now"
    assert_same_map(submaps, whole)


def test_keyframes_that_see_parked_gaussians_are_hidden_until_they_are_visited(device: str) -> None:
    _, submaps = room(device, MapBudget(0), np.random.default_rng(3))
    between = se3.se3_exp([0.0, 0.0, 0.0, 0.0, np.pi / 4, 0.0])
    submaps.show(between, DEPTH)
    submaps.add(between, DEPTH)
    submaps.show(TURNS[0], DEPTH)
    hidden = submaps.hidden_keyframes()
    assert submaps.parked == [2, 3], "the newest keyframe sees the other two"
    assert hidden is not None and hidden.tolist() == [False, False, True, True, False]
    submaps.visit([2, 2])
    for view in (TURNS[0], TURNS[1]):
        submaps.show(view, DEPTH)
        assert submaps.parked == [3], "it stays until the next visit"
    submaps.visit([3])
    assert submaps.parked == [2]
    assert room(device, None, np.random.default_rng(3))[1].hidden_keyframes() is None


def test_a_keyframe_joins_the_submap_whose_middle_it_sees(device: str) -> None:
    submaps = Submaps(GaussianMap(device=device, has_identity=False), CAMERA)
    for turn in (0.0, 0.2, 1.6, 1.5, 0.1):
        submaps.add(se3.se3_exp([0.0, 0.0, 0.0, 0.0, turn, 0.0]), DEPTH)
    submaps.add(np.eye(4), np.zeros((48, 64), np.float32))
    submaps.add(np.eye(4), None)
    # Without a reading it looks at where it stands.
    assert submaps._submap_of.tolist() == [0, 0, 1, 1, 0, 2, 2]


@pytest.mark.parametrize("budget", [MapBudget(0), None])
def test_a_restored_one_is_the_same(budget: MapBudget | None, device: str) -> None:
    gaussians, submaps = room(device, MapBudget(0), np.random.default_rng(3))
    submaps.show(TURNS[0], DEPTH)
    submaps.move(np.stack([np.eye(4)] + 3 * [se3.se3_exp([0.1, 0, 0, 0, 0, 0])]))
    other = GaussianMap(device=device, has_identity=True)
    restored = Submaps(other, CAMERA, budget)

    other.restore(gaussians.state(), lambda index: pytest.fail("no frame is needed"))
    restored.restore(submaps.state(), lambda index: pytest.fail("no frame is needed"))

    assert restored.parked == ([1, 2] if budget else [])
    assert_same_map(restored, submaps)
    if budget:
        for turn in (1, 3, 0):
            for each in (submaps, restored):
                each.show(TURNS[turn], DEPTH)
            assert restored.parked == submaps.parked
            np.testing.assert_array_equal(other.to_host().means, gaussians.to_host().means)


def test_a_file_that_cannot_be_made_parks_nothing_away(device: str, tmp_path: Path) -> None:
    budget = MapBudget(0, lambda: tmp_path / "gone")
    _, submaps = room(device, budget, np.random.default_rng(3))
    _, whole = room(device, None, np.random.default_rng(3))
    submaps.show(TURNS[2], DEPTH)
    assert_same_map(submaps, whole)
    assert len(join(*(part.to_host() for part in submaps.parts()))) == whole.count


def test_a_keyframe_that_is_added_is_hidden_by_what_is_parked_again(device: str) -> None:
    """Of a submap that is as it was, only the new ones are looked at; of one that has moved, all of them."""
    gaussians, submaps = room(device, MapBudget(0), np.random.default_rng(3))
    submaps.show(TURNS[2], DEPTH)
    assert submaps.parked == [0, 1]
    submaps.show(TURNS[1], DEPTH)
    nearly = se3.se3_exp([0.1, 0.0, 0.0, 0.0, np.pi / 2 + 0.1, 0.0])
    submaps.add(nearly, DEPTH)
    submaps.add(TURNS[3], DEPTH)
    around = submaps._submaps[1].around
    submaps.show(TURNS[3], DEPTH)
    hidden = submaps.hidden_keyframes()
    assert 1 in submaps.parked and submaps._submaps[1].around is around
    assert hidden is not None and hidden.tolist()[1:6:3] == [True, True] and not hidden[5]
    submaps.show(TURNS[1], DEPTH)
    means = to_host(gaussians.fields["means"]).copy()
    means[: gaussians.count, 1] += 0.3
    gaussians.fields["means"].assign(means)
    gaussians.version += 1
    submaps.show(TURNS[3], DEPTH)
    assert 1 in submaps.parked and submaps._submaps[1].around is not around
