# SPDX-License-Identifier: Apache-2.0
"""Depth that cannot be what it is taken for: units, whole metres, stretched ranges, distances along rays."""

import numpy as np
import pytest

from ggwarp.datasets.plan.depth_checks import depth_faults, depth_statistics
from ggwarp.geometry.camera import Camera

CAMERA = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)


def room(distance: float = 2.5, frames: int = 4, slant: float = 0.3) -> list[np.ndarray]:
    """A slanted wall and a floor, metres, seen from ever nearer; 16-bit millimetres."""
    v, u = np.mgrid[:120, :160]
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    images = []
    for i in range(frames):
        wall = distance * (1.0 - 0.02 * i) / (1.0 + slant * x)
        with np.errstate(divide="ignore"):
            floor = np.where(y > 0.0, 0.4 * distance / y, np.inf)
        images.append((np.rint(1000.0 * np.minimum(wall, floor)) / 1000.0).astype(np.float32))
    return images


def reasons(images: list[np.ndarray], scale: float | None = 1000.0) -> list[tuple[str, bool]]:
    return [(fault.reason, fault.certain) for fault in depth_faults(images, CAMERA, scale)]


def test_depth_of_a_room_is_not_doubted() -> None:
    median, share = depth_statistics(room())
    assert median == pytest.approx(2.1, abs=0.4) and share == 1.0
    assert reasons(room()) == [] and reasons(room(), None) == []


@pytest.mark.parametrize(
    ("distance", "certain", "says"),
    [
        (0.05, False, "the median depth is 0.04"),
        (60.0, False, "1000 is taken for a metre: is that right"),
        (0.02, True, "no camera sees that; give the depth's scale"),
        (3e3, True, "no camera sees that"),
    ],
)
def test_a_unit_that_is_off(distance: float, certain: bool, says: str) -> None:
    ((reason, sure),) = reasons(room(distance))
    assert sure == certain and says in reason


def test_float_depth_names_metres() -> None:
    ((reason, _),) = reasons(room(60.0), None)
    assert "their values are taken for metres" in reason


def test_metres_cut_to_whole_numbers() -> None:
    ((reason, certain),) = reasons([np.floor(image).astype(np.float32) / 1000.0 for image in room()])
    assert (
        certain and "different values, the largest 3 (3 mm): are they metres cut to whole numbers" in reason
    )


def test_one_wall_straight_ahead_is_no_measurement_error() -> None:
    assert reasons([np.full((120, 160), 2.0, np.float32)] * 4) == []


@pytest.mark.parametrize("end", [255, 65535])
def test_images_stretched_to_their_own_range(end: int) -> None:
    stretched = [np.rint(image / image.max() * end).astype(np.float32) / end * 5.0 for image in room()]
    ((reason, certain),) = reasons(stretched, end / 5.0)
    assert certain and "each stretched to its own range" in reason


def test_holes_marked_by_the_largest_value_are_no_stretching() -> None:
    images = room()
    for image in images:
        image[:9, :9] = 65.534
    assert reasons(images) == []


def test_distances_along_the_rays_are_told() -> None:
    v, u = np.mgrid[:120, :160]
    rays = np.sqrt(1.0 + ((u - CAMERA.cx) / CAMERA.fx) ** 2 + ((v - CAMERA.cy) / CAMERA.fy) ** 2)
    ((reason, certain),) = reasons([(image * rays).astype(np.float32) for image in room()])
    assert not certain and "flat only if depth is the distance along each pixel's ray" in reason


def test_disparity_is_told() -> None:
    ((reason, certain),) = reasons([(4.0 / image).astype(np.float32) for image in room(slant=0.9)])
    assert (
        not certain
        and not reasons(room(slant=0.9))
        and "flat only if the depth images hold disparity" in reason
    )


def test_no_reading_at_all() -> None:
    assert depth_statistics([]) == (None, None)
    empty = [np.zeros((120, 160), np.float32)] * 3
    assert depth_statistics(empty) == (None, 0.0)
    ((reason, certain),) = reasons(empty)
    assert not certain and "no reading at all" in reason
