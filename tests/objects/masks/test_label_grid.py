# SPDX-License-Identifier: Apache-2.0
"""The grid of pixels by which large pictures' objects are told, and the way back to every pixel."""

import numpy as np
import pytest

from ggwarp.geometry.camera import Camera
from ggwarp.geometry.pixel_grid import PixelGrid
from ggwarp.objects.class_table import ClassTable
from ggwarp.objects.masks.keyframe_labels import KeyframeLabels
from ggwarp.objects.masks.label_grid import changed, of_mask

LARGE = Camera(1201, 683, 600.0, 610.0, 600.3, 340.7)


def test_small_pictures_are_looked_at_whole(rng: np.random.Generator) -> None:
    camera = Camera(300, 170, 150.0, 150.0, 149.5, 84.5)
    grid = PixelGrid.of(camera)
    assert grid == PixelGrid(camera, 1)
    labels, mask = rng.integers(-1, 9, (2, 170, 300)).astype(np.int32)
    np.testing.assert_array_equal(grid.thinned(labels), labels)
    assert grid.spread(labels, labels.shape) is labels
    assert of_mask(grid, labels, mask) is labels and changed(grid, mask, labels) is labels


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
def test_labels_of_the_grid_come_back_pixel_by_pixel(names: np.ndarray, rng: np.random.Generator) -> None:
    grid, shape = PixelGrid.of(LARGE), (683, 1201)
    rows, columns = np.indices(shape)
    number = (rows // 90 + columns // 130) % 6
    mask = names[number + 1].astype(np.int32)
    mask[rng.random(shape) < 0.02] = -1
    of = np.array([-1, 0, 3, 1, 9, 2, 4], np.int32)
    labels = np.where(mask < 0, -1, of[number + 1]).astype(np.int32)
    # Borders and dots are the mask's own, though the grid has every fourth pixel only.
    np.testing.assert_array_equal(of_mask(grid, grid.thinned(labels), mask), labels)
    # An object under a wrong id, found at the grid's pixels.
    few = grid.thinned(labels)
    few[:20, :20] = 17
    corrected = of_mask(grid, few, mask)
    assert (corrected[: 20 * grid.step, : 20 * grid.step] == 17).all()
    beyond = np.ones(shape, bool)
    beyond[: 20 * grid.step, : 20 * grid.step] = False
    np.testing.assert_array_equal(corrected[beyond], labels[beyond])
    np.testing.assert_array_equal(changed(grid, labels, few), corrected)


def test_an_id_that_the_grid_misses_says_nothing() -> None:
    grid = PixelGrid.of(LARGE)
    mask = np.zeros((683, 1201), np.int32)
    mask[0, 0] = 5
    labels = of_mask(grid, grid.thinned(mask), mask)
    assert labels[0, 0] == -1 and (labels.ravel()[1:] == 0).all()


def test_a_spread_picture_has_each_grid_pixel_in_the_middle_of_its_block(rng: np.random.Generator) -> None:
    grid = PixelGrid.of(LARGE)
    few = rng.integers(0, 99, (grid.camera.height, grid.camera.width)).astype(np.int32)
    whole = grid.spread(few, (683, 1201))
    assert whole.shape == (683, 1201)
    np.testing.assert_array_equal(grid.thinned(whole), few)
    assert (whole[: grid.step, : grid.step] == few[0, 0]).all()


@pytest.mark.parametrize("camera", [LARGE, Camera(30, 20, 20.0, 20.0, 14.5, 9.5)])
def test_a_keyframe_is_labelled_again_only_where_it_is_news(camera: Camera, rng: np.random.Generator) -> None:
    grid, classes = PixelGrid.of(camera), ClassTable()
    shape = camera.height, camera.width
    given = classes.encode(rng.integers(0, 5, shape).astype(np.int32))
    kept = KeyframeLabels(classes, grid)
    kept.keep(7, given)
    few = grid.thinned(given)
    first = kept.relabelled(7, few, shape)
    assert first is not None
    np.testing.assert_array_equal(first, given)
    assert kept.relabelled(7, few.copy(), shape) is None
    few = few.copy()
    few[3:5] = -1
    news = kept.relabelled(7, few, shape)
    assert news is not None and (grid.thinned(news) == few).all() and (news == -1).any()
    assert kept.relabelled(7, few, shape) is None
