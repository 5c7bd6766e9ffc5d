# SPDX-License-Identifier: Apache-2.0
"""Colour of other depths, with alpha, in grey, or turned: the same picture."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from ggwarp.datasets import FrameError
from ggwarp.datasets.images import read_colour


@pytest.fixture
def picture(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (20, 32, 3)).astype(np.uint8)


@pytest.mark.parametrize("kind", ["alpha", "sixteen", "tiff", "ppm"])
def test_the_same_picture(tmp_path: Path, picture: np.ndarray, kind: str) -> None:
    path = tmp_path / {"tiff": "c.tif", "ppm": "c.ppm"}.get(kind, "c.png")
    bgr = picture[..., ::-1]
    if kind == "alpha":
        bgr = np.dstack([bgr, np.full(bgr.shape[:2], 77, np.uint8)])
    if kind == "sixteen":
        bgr = bgr.astype(np.uint16) * 257
    assert cv2.imwrite(str(path), bgr)
    np.testing.assert_array_equal(read_colour(path, (32, 20)), picture)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_is_all_three_channels(tmp_path: Path, picture: np.ndarray, dtype: type) -> None:
    grey = picture[..., 0].astype(dtype) * (257 if dtype is np.uint16 else 1)
    assert cv2.imwrite(str(tmp_path / "g.pgm"), grey)
    np.testing.assert_array_equal(read_colour(tmp_path / "g.pgm"), np.dstack([picture[..., 0]] * 3))


@pytest.mark.parametrize(("orientation", "turns"), [(6, 3), (8, 1)])
def test_a_quarter_by_exif_is_turned_where_the_size_asks_for_it(
    tmp_path: Path, picture: np.ndarray, orientation: int, turns: int
) -> None:
    path = tmp_path / "c.jpg"
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(picture).save(path, exif=exif, quality=95)
    as_stored = read_colour(path, (32, 20))
    np.testing.assert_array_equal(read_colour(path, (20, 32)), np.rot90(as_stored, turns))
    np.testing.assert_array_equal(np.rot90(as_stored, turns), cv2.imread(str(path))[..., ::-1])
    np.testing.assert_array_equal(read_colour(path), as_stored)  # depth follows the sensor's pixels
    with pytest.raises(FrameError, match="32x20, but 20x31"):
        read_colour(path, (20, 31))
