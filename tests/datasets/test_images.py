# SPDX-License-Identifier: Apache-2.0
"""Damaged image files, which OpenCV would read in part and in silence."""

import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ggwarp.datasets import DatasetError, FrameError
from ggwarp.datasets.images import image_size, read_colour, read_depth, weighted


@pytest.fixture
def png(tmp_path: Path, rng: np.random.Generator, sample: SimpleNamespace) -> Path:
    return sample.save(tmp_path / "depth.png", rng.integers(0, 60000, (40, 50)).astype(np.uint16))


@pytest.fixture
def jpg(tmp_path: Path, rng: np.random.Generator, sample: SimpleNamespace) -> Path:
    return sample.save(tmp_path / "colour.jpg", rng.integers(0, 255, (40, 50, 3)).astype(np.uint8))


def test_confidence_is_a_weight_and_the_least_leaves_readings_out() -> None:
    depth = np.float32([[1.0, 2.0, 3.0, 0.0]])
    seen, weights = weighted(depth, np.uint8([[0, 1, 2, 1]]))
    np.testing.assert_array_equal(seen, [[0.0, 2.0, 3.0, 0.0]])
    assert weights is not None
    np.testing.assert_array_equal(weights, [[0.0, 0.5, 1.0, 0.5]])
    np.testing.assert_allclose(
        weighted(depth, np.uint8([[255, 127, 255, 0]]))[1], [[1.0, 127 / 255, 1.0, 0.0]]
    )
    seen, weights = weighted(depth, np.uint8([[2, 2, 0, 1]]))
    assert weights is None and seen[0, 2] == 0.0, "those that are left are all as sure"


def test_depth_is_raw_over_scale(png: Path) -> None:
    raw = cv2.imread(str(png), cv2.IMREAD_UNCHANGED)
    depth = read_depth(png, scale=6553.5)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, raw / 6553.5, rtol=1e-6)


@pytest.mark.parametrize("keep", [1, 20, 0.5, -1, -12])
def test_a_truncated_png_is_refused(png: Path, keep: float) -> None:
    data = png.read_bytes()
    png.write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(FrameError, match=r"depth\.png: is (truncated after|not an image)"):
        read_depth(png, scale=1000)


@pytest.mark.parametrize("keep", [0.3, 0.99])
def test_a_truncated_jpeg_is_refused(jpg: Path, keep: float) -> None:
    data = jpg.read_bytes()
    jpg.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(FrameError, match=r"colour\.jpg: is truncated"):
        read_colour(jpg)


def test_a_padded_jpeg_is_whole(jpg: Path) -> None:
    want = read_colour(jpg)
    jpg.write_bytes(jpg.read_bytes() + bytes(500))
    np.testing.assert_array_equal(read_colour(jpg), want)


def test_a_png_with_a_flipped_bit_is_refused(png: Path) -> None:
    data = bytearray(png.read_bytes())
    data[len(data) // 2] ^= 4
    png.write_bytes(data)
    with pytest.raises(FrameError, match="a checksum does not match"):
        read_depth(png, scale=1000)


def test_a_png_whose_checksums_hold_but_whose_data_ends_early_is_refused(tmp_path: Path) -> None:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 50, 40, 16, 0, 0, 0, 0))
    data = chunk(b"IDAT", zlib.compress(bytes(101 * 10)))
    path = tmp_path / "short.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + data + chunk(b"IEND", b""))
    try:
        depth = read_depth(path, scale=1000)
    except FrameError as error:
        assert "short.png" in str(error)
    else:
        # Some versions of libpng fill what is missing with zeros: no reading, so nothing false.
        assert not depth.any()


@pytest.mark.parametrize(
    ("content", "says"), [(b"", "is empty"), (b"not an image at all", "is not an image")]
)
def test_what_is_no_image_is_refused(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(FrameError, match=says):
        read_colour(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=r"gone\.png: cannot be read \(No such file"):
        read_colour(tmp_path / "gone.png")


def test_eight_bit_depth_is_refused(tmp_path: Path, sample: SimpleNamespace) -> None:
    path = sample.save(tmp_path / "d.png", np.ones((4, 4), np.uint8))
    with pytest.raises(FrameError, match=r"1 channel\(s\) of uint8"):
        read_depth(path, scale=1000)


def test_the_size_is_that_of_the_first_good_image(jpg: Path, tmp_path: Path) -> None:
    assert image_size([tmp_path / "gone.jpg", jpg]) == (50, 40)
    with pytest.raises(DatasetError, match=r"gone\.jpg"):
        image_size([tmp_path / "gone.jpg"])
