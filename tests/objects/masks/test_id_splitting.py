# SPDX-License-Identifier: Apache-2.0
"""One id for two objects: they are split by where they are."""

import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.objects import class_table
from ggwarp.objects.class_table import IGNORED, ClassTable
from ggwarp.objects.masks import id_splitting
from ggwarp.objects.masks.id_splitting import SharedIdSplitter, SplittingConfig, _clusters
from ggwarp.objects.masks.mask_view import MapKnowledge, MaskView, PosedDepth

CAMERA = Camera(60, 40, 50.0, 50.0, 29.5, 19.5)
UNKNOWN = np.full((40, 60), IGNORED, np.int32)


class Wall:
    """A wall at z = 2 m with squares of 0.4 m on it, seen from x; a view shows 2.4 m of it."""

    def __init__(self, squares: dict[float, int], **options) -> None:
        self.squares = squares
        self.classes = ClassTable()
        self.splitter = SharedIdSplitter(SplittingConfig(**options), self.classes)

    def view(self, x: float) -> tuple[np.ndarray, PosedDepth]:
        T_wc = se3.se3_exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0]))
        view = PosedDepth(np.full((40, 60), 2.0, np.float32), T_wc, CAMERA)
        points = view.places.T.reshape(40, 60, 3)
        mask = np.full((40, 60), 99, np.int32)
        for middle, identifier in self.squares.items():
            mask[(np.abs(points[..., 0] - middle) < 0.2) & (np.abs(points[..., 1]) < 0.2)] = identifier
        return self.classes.encode(mask), view

    def look(self, x: float, known: np.ndarray = UNKNOWN) -> tuple[np.ndarray, set[int]]:
        given, view = self.view(x)
        return self.split(given, known, view)

    def split(self, given: np.ndarray, known: np.ndarray, view: PosedDepth) -> tuple[np.ndarray, set[int]]:
        knowledge = MapKnowledge(known, known, known)
        mask = self.splitter.split_shared_ids(MaskView(view, given, knowledge))
        return mask.labels, set(mask.fresh)

    def look_thrice(self, x: float) -> tuple[np.ndarray, set[int]]:
        """Look as often as an object wants, and return the last of it."""
        return [self.look(x) for _ in range(3)][-1]


def test_a_part_far_away_is_another_object_at_its_third_view() -> None:
    wall = Wall({0.0: 7, 5.0: 7})
    (one,) = set(np.unique(wall.look_thrice(0.0)[0])) - {wall.classes.encode(np.array([99]))[0]}
    for _ in range(2):
        labels, fresh = wall.look(5.0)
        assert one in labels and not fresh
    given, _ = wall.view(5.0)
    labels, (other,) = wall.look(5.0)
    assert other == wall.classes.count - 1 and wall.classes.same_mask_id(one, other)
    assert ((labels == other) == (given == one)).all() and (labels == given)[given != one].all()
    assert one in wall.look(0.0)[0]
    for _ in range(5):
        labels, fresh = wall.look(5.1)
    assert other in labels and one not in labels and not fresh
    name = int(wall.classes.ids[other])
    assert name not in (0, 7, 99) and not wall.classes.knows(name)
    assert wall.classes.sources() == {name: (7,)}
    assert wall.splitter.grown_together() == []


def test_a_full_table_splits_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = Wall({0.0: 7, 5.0: 7})
    (one,) = set(np.unique(wall.look_thrice(0.0)[0])) - {wall.classes.encode(np.array([99]))[0]}
    monkeypatch.setattr(class_table, "MOST_CLASSES", wall.classes.count)
    for _ in range(2):
        labels, fresh = wall.look_thrice(5.0)
        assert one in labels and IGNORED not in labels and not fresh


@pytest.mark.parametrize("within_frames", [False, True])
def test_what_one_frame_shows_under_an_id_is_one_object_unless_asked(within_frames: bool) -> None:
    wall = Wall({-0.9: 7, 0.9: 7}, within_frames=within_frames)
    for _ in range(4):
        labels, fresh = wall.look(0.0)
    assert len(np.unique(labels)) == (3 if within_frames else 2)
    assert bool(fresh) == within_frames
    if within_frames:
        left, right = labels[:, :30], labels[:, 30:]
        assert set(np.unique(left)) != set(np.unique(right)), "each square is one object"


def test_what_comes_into_view_together_is_one_after_all() -> None:
    wall = Wall({-0.9: 7, 0.9: 7})
    wall.look_thrice(-1.6)
    labels, (other,) = wall.look_thrice(1.6)
    assert other in labels
    assert wall.splitter.grown_together() == []
    wall.look(0.0)
    (pair,) = wall.splitter.grown_together()
    assert pair == (1 if pair[0] == 1 else 2, other)
    wall.classes.merge(*pair)
    wall.splitter.merge(*pair)
    labels, fresh = wall.look(1.5)
    assert other not in labels and pair[0] in labels and not fresh


def test_a_swap_at_first_sight_is_not_the_id_s_place() -> None:
    """One frame at the wrong place, then the object itself: it keeps its id."""
    wall = Wall({0.0: 7, 5.0: 7})
    wall.look(5.0)
    labels, fresh = wall.look_thrice(0.0)
    given, _ = wall.view(0.0)
    np.testing.assert_array_equal(labels, given)
    assert not fresh


def test_parts_near_each_other_are_one() -> None:
    """Nearer than their own size."""
    wall = Wall({0.0: 7, 0.6: 7})
    for _ in range(5):
        wall.look(-0.9)
        labels, fresh = wall.look(1.5)
        assert not fresh and len(np.unique(labels)) == 2, wall.splitter._parts


def test_an_object_that_the_map_knows_is_not_the_id_s() -> None:
    """A mask that gives a known object another's id for a while says nothing about that other."""
    wall = Wall({0.0: 7, 5.0: 7})
    wall.look_thrice(0.0)
    known = wall.view(5.0)[0]
    known = np.where(known == known[0, 0], IGNORED, 3).astype(np.int32)
    wall.classes.encode(np.array([11, 12, 13]))
    for _ in range(5):
        labels, fresh = wall.look(5.0, known)
        assert not fresh and 3 not in labels


@pytest.mark.parametrize("change", [{"views": 0}, {"_LEAST_AREA": 0.5}, {"_GAP": 20.0}], ids=str)
def test_switched_off_or_too_small_or_not_far_enough(
    change: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in change.items():
        if name != "views":
            monkeypatch.setattr(id_splitting, name, value)
    wall = Wall({0.0: 7, 5.0: 7}, **{name: value for name, value in change.items() if name == "views"})
    wall.look_thrice(0.0)
    for _ in range(5):
        given, _ = wall.view(5.0)
        labels, fresh = wall.look(5.0)
        np.testing.assert_array_equal(labels, given)
        assert not fresh


def test_pixels_without_depth_are_nobody_s() -> None:
    wall = Wall({0.0: 7, 5.0: 7})
    wall.look_thrice(0.0)
    wall.look_thrice(5.0)
    given, view = wall.view(5.0)
    holed = view.depth.copy()
    holed[:20] = 0.0
    labels, _ = wall.split(given, UNKNOWN, PosedDepth(holed, view.T_wc, CAMERA))
    square = given != given[0, 0]
    assert (labels[:20][square[:20]] == IGNORED).all() and (labels[20:][square[20:]] > 0).all()
    assert (labels[~square] == given[~square]).all()


def test_a_frame_without_depth_or_objects_changes_nothing() -> None:
    wall = Wall({0.0: 7})
    given, view = wall.view(0.0)
    for image, depth in ((given, view.depth * 0.0), (given * 0, view.depth), (UNKNOWN, view.depth)):
        labels, fresh = wall.split(image, UNKNOWN, PosedDepth(depth, view.T_wc, CAMERA))
        np.testing.assert_array_equal(labels, image)
        assert not fresh and wall.splitter.grown_together() == []


def test_merged_with_another_object_the_parts_go_along() -> None:
    wall = Wall({0.0: 7, 5.0: 7, 10.0: 8})
    wall.look_thrice(0.0)
    one = int(wall.classes.encode(np.array([7]))[0])
    wall.look_thrice(10.0)
    _, fresh = wall.look_thrice(5.0)
    (other,) = (i for i in fresh if wall.classes.same_mask_id(i, one))
    eight = int(wall.classes.encode(np.array([8]))[0])
    wall.classes.merge(eight, one)
    wall.splitter.merge(eight, one)
    assert eight in wall.look(0.0)[0] and eight in wall.look(10.0)[0]
    assert other in wall.look(5.0)[0]


def test_clusters_hang_together(rng: np.random.Generator) -> None:
    middles = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 9.0, 0.0]])
    owners = rng.integers(0, 3, 300)
    points = middles[owners] + rng.uniform(-0.3, 0.3, (300, 3))
    found = _clusters(points, 1.0)
    assert sorted(len(c) for c in found) == sorted(np.bincount(owners))
    assert all(len(set(owners[c])) == 1 for c in found)
    assert [c.tolist() for c in _clusters(points[:1], 1.0)] == [[0]]
