# SPDX-License-Identifier: Apache-2.0
"""The grid of pixels by which large pictures' objects are told, and the way back to every pixel."""

import numpy as np
import pytest

from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pixel_grid import PixelGrid
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.masks.keyframe_labels import KeyframeLabels
from ggwarp.objects.masks.label_grid import LabelPictures, MaskLabels, PackedLabels

LARGE = Camera(1201, 683, 600.0, 610.0, 600.3, 340.7)


def pictures(
    grid: PixelGrid, labels: MaskLabels, *few: np.ndarray, device: str, **options
) -> list[np.ndarray]:
    """The labels of all pixels by the votes, and by each of other labels of the grid's pixels."""
    shape = (683, 1201) if grid.step > 1 else labels.votes.shape
    made = LabelPictures(grid, device=device).changed(labels, shape, *few, **options)
    return [picture.numpy() for picture in made if picture is not None]


def by_mask(grid: PixelGrid, few: np.ndarray, mask: np.ndarray | None, device: str) -> np.ndarray:
    return pictures(grid, MaskLabels.of(grid, few, mask), few, few, device=device)[0]


def test_small_pictures_are_looked_at_whole(device: str, rng: np.random.Generator) -> None:
    camera = Camera(300, 170, 150.0, 150.0, 149.5, 84.5)
    grid = PixelGrid.of(camera)
    assert grid == PixelGrid(camera, 1)
    votes, one, other, mask = rng.integers(-1, 9, (4, 170, 300)).astype(np.int32)
    np.testing.assert_array_equal(grid.thinned(votes), votes)
    labels, without = MaskLabels.of(grid, votes, mask), rng.random(votes.shape) < 0.1
    found = pictures(grid, labels, one, other, device=device, without=without)
    for picture, expected in zip(found, (votes, np.where(without, -1, one), other), strict=True):
        np.testing.assert_array_equal(picture, expected)


def test_the_grid_s_camera_sees_its_pixels_where_they_are(rng: np.random.Generator) -> None:
    grid = PixelGrid.of(LARGE)
    depth = rng.uniform(1.0, 3.0, (683, 1201)).astype(np.float32)
    few = grid.thinned(depth)
    assert few.shape == (grid.camera.height, grid.camera.width) and 45_000 < few.size < 60_000
    rows, columns = np.indices(depth.shape)
    whole = grid.thinned(LARGE.back_project(columns, rows, depth))
    rows, columns = np.indices(few.shape)
    np.testing.assert_allclose(grid.camera.back_project(columns, rows, few), whole, rtol=1e-6)


@pytest.mark.parametrize("names", [np.arange(-1, 6), np.array([-1, 0, 7, 2**31 - 2, 5_000_000, 11, 12])])
def test_labels_of_the_grid_come_back_pixel_by_pixel(
    names: np.ndarray, device: str, rng: np.random.Generator
) -> None:
    grid, shape = PixelGrid.of(LARGE), (683, 1201)
    rows, columns = np.indices(shape)
    number = (rows // 90 + columns // 130) % 6
    mask = names[number + 1].astype(np.int32)
    mask[rng.random(shape) < 0.02] = -1
    of = np.array([-1, 0, 3, 1, 9, 2, 4], np.int32)
    labels = np.where(mask < 0, -1, of[number + 1]).astype(np.int32)
    # Borders and dots are the mask's own, though the grid has every fourth pixel only.
    few = grid.thinned(labels)
    np.testing.assert_array_equal(by_mask(grid, few, mask, device), labels)
    # An object under a wrong id, found at the grid's pixels.
    wrong, right = few.copy(), few
    wrong[:20, :20] = 17
    beyond = np.ones(shape, bool)
    beyond[: 20 * grid.step, : 20 * grid.step] = False
    corrected = np.where(beyond, labels, 17)
    np.testing.assert_array_equal(by_mask(grid, wrong, mask, device), corrected)
    without = rng.random(shape) < 0.1
    given = MaskLabels.of(grid, right, mask)
    same, training, seeds = pictures(grid, given, wrong, right, device=device, without=without)
    np.testing.assert_array_equal(same, labels)
    np.testing.assert_array_equal(training, np.where(without, -1, corrected))
    np.testing.assert_array_equal(seeds, labels)


def test_an_id_that_the_grid_misses_says_nothing(device: str) -> None:
    grid = PixelGrid.of(LARGE)
    for missed in (5, 1):
        mask = np.zeros((683, 1201), np.int32)
        mask[2, 2], mask[0, 0] = 4, missed
        labels = by_mask(grid, grid.thinned(mask), mask, device)
        assert labels[0, 0] == -1 and labels[2, 2] == 4 and np.count_nonzero(labels) == 2


@pytest.mark.parametrize("dots", [1.0, 0.01, 0.0], ids=["all runs are a pixel long", "few are", "one id"])
def test_labels_of_all_pixels_are_those_of_a_slower_rule(
    dots: float, device: str, rng: np.random.Generator
) -> None:
    grid, shape = PixelGrid.of(LARGE), (683, 1201)
    mask = np.where(rng.random(shape) < dots, rng.integers(-1, 40, shape), 3).astype(np.int32)
    votes, other = rng.integers(-1, 9, (2, grid.camera.height, grid.camera.width)).astype(np.int32)
    given = MaskLabels.of(grid, votes, mask)
    usual = given.usual[np.minimum(mask + 1, len(given.usual) - 1)]
    rows, columns = (
        np.minimum(np.arange(size) // grid.step, few - 1)
        for size, few in zip(shape, votes.shape, strict=True)
    )
    block = np.ix_(rows, columns)
    label = np.where(grid.thinned(usual)[block] == votes[block], usual, votes[block])
    changed = np.where(other[block] == votes[block], label, other[block])
    first, second, third = pictures(grid, given, other, votes, device=device)
    for found, expected in ((first, label), (second, changed), (third, label)):
        np.testing.assert_array_equal(found, expected)


def test_runs_of_another_picture_are_refused(device: str) -> None:
    grid, mask = PixelGrid.of(LARGE), np.zeros((683, 1201), np.int32)
    given = MaskLabels.of(grid, grid.thinned(mask), mask)
    with pytest.raises(ValueError, match="1200x683"):
        LabelPictures(grid, device=device).changed(given, (683, 1200), given.votes)


def test_without_a_mask_each_block_is_as_its_grid_pixel(device: str, rng: np.random.Generator) -> None:
    grid = PixelGrid.of(LARGE)
    few = rng.integers(0, 99, (grid.camera.height, grid.camera.width)).astype(np.int32)
    whole = by_mask(grid, few, None, device)
    assert whole.shape == (683, 1201)
    np.testing.assert_array_equal(grid.thinned(whole), few)
    assert (whole[: grid.step, : grid.step] == few[0, 0]).all()
    assert (whole[(len(few) - 1) * grid.step :, -1] == few[-1, -1]).all(), "what is left over"


@pytest.mark.parametrize("camera", [LARGE, Camera(30, 20, 20.0, 20.0, 14.5, 9.5)])
def test_a_keyframe_is_labelled_again_only_where_it_is_news(
    camera: Camera, device: str, rng: np.random.Generator
) -> None:
    grid, classes = PixelGrid.of(camera), ClassTable()
    shape = camera.height, camera.width
    mask = np.repeat(rng.integers(-1, 5, (shape[0], 1)), shape[1], axis=1).astype(np.int32)
    given = classes.encode(mask)
    kept = KeyframeLabels(classes, LabelPictures(grid, device=device))
    few = grid.thinned(given)
    kept.keep(7, MaskLabels.of(grid, few, mask))
    first = kept.relabelled(7, few, shape)
    assert first is not None
    np.testing.assert_array_equal(first.numpy(), given)
    assert kept.relabelled(7, few.copy(), shape) is None
    few = few.copy()
    few[3:5] = -1
    news = kept.relabelled(7, few, shape).numpy()
    assert (grid.thinned(news) == few).all() and (news == -1).any()
    assert kept.relabelled(7, few, shape) is None


def test_classes_merged_since_are_one_in_what_was_kept(rng: np.random.Generator) -> None:
    grid, classes = PixelGrid.of(LARGE), ClassTable()
    mask = np.repeat(rng.integers(-1, 5, (683, 1)), 1201, axis=1).astype(np.int32)
    labels = MaskLabels.of(grid, classes.encode(grid.thinned(mask)), mask)
    packed = PackedLabels.of(labels)
    same = packed.unpacked(labels.votes.shape, classes)
    for name in ("mask", "usual", "votes"):
        np.testing.assert_array_equal(getattr(same, name), getattr(labels, name))
    classes.merge(2, 3)
    merged = packed.unpacked(labels.votes.shape, classes)
    np.testing.assert_array_equal(merged.votes, np.where(labels.votes == 3, 2, labels.votes))
    np.testing.assert_array_equal(merged.usual, np.where(labels.usual == 3, 2, labels.usual))
