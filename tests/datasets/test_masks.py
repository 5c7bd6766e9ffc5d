# SPDX-License-Identifier: Apache-2.0
"""Object masks: the three forms, matching, other sizes."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ggwarp.datasets import DatasetError, FrameError, open_dataset
from ggwarp.datasets.base import MaskChoice
from ggwarp.datasets.formats.mask_file import read_mask, write_mask
from ggwarp.datasets.masks import find_masks
from ggwarp.datasets.readers.replica import open_sequence

Maker = Callable[..., Path]
IDS = np.array([[0, 1, 2, 3], [7, 7, 0, 14]])


def save_palette(path: Path, indices: np.ndarray, *, bits: int = 8, colours: int | None = None) -> Path:
    """Write a palette PNG with zlib alone; every entry of the palette is the same grey."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    height, width = indices.shape
    per_byte = 8 // bits
    padded = np.zeros((height, -(-width // per_byte) * per_byte), np.uint8)
    padded[:, :width] = indices
    packed = np.zeros((height, padded.shape[1] // per_byte), np.uint8)
    for i in range(per_byte):
        packed |= padded[:, i::per_byte] << (8 - bits * (i + 1))
    rows = b"".join(b"\x00" + row.tobytes() for row in packed)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 3, 0, 0, 0))
        + chunk(b"PLTE", bytes([128, 128, 128]) * (colours or 2**bits))
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )
    return path


@pytest.mark.parametrize(("dtype", "offset"), [(np.uint8, 0), (np.uint8, 241), (np.uint16, 60000)])
def test_one_channel_is_the_id(tmp_path: Path, sample: SimpleNamespace, dtype: type, offset: int) -> None:
    ids = np.where(IDS > 0, IDS + offset, 0)
    read = read_mask(sample.save(tmp_path / "m.png", ids.astype(dtype)))
    assert read.dtype == np.int32
    np.testing.assert_array_equal(read, ids)


def test_rgb_codes_the_id_red_lowest(tmp_path: Path, sample: SimpleNamespace) -> None:
    ids = np.array([[0, 5, 256, 65536], [16777215, 70000, 300, 1]])
    bgr = np.stack([ids >> 16, (ids >> 8) & 255, ids & 255], axis=-1).astype(np.uint8)
    np.testing.assert_array_equal(read_mask(sample.save(tmp_path / "m.png", bgr)), ids)
    opaque = np.concatenate([bgr, np.full((2, 4, 1), 255, np.uint8)], axis=-1)
    np.testing.assert_array_equal(read_mask(sample.save(tmp_path / "m4.png", opaque)), ids)


@pytest.mark.parametrize("largest", [0, 255, 256, 65535, 65536, (1 << 24) - 1])
def test_what_is_written_is_read(tmp_path: Path, largest: int) -> None:
    ids = np.array([[0, largest // 3, largest], [largest // 2, 0, largest // 7]], np.int32)
    write_mask(tmp_path / "m.png", ids)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), ids)


def test_ids_that_no_mask_holds_are_refused(tmp_path: Path) -> None:
    for ids in ([[-1]], [[1 << 24]]):
        with pytest.raises(ValueError, match="a mask holds 0 to"):
            write_mask(tmp_path / "m.png", np.array(ids, np.int32))


@pytest.mark.parametrize(("bits", "modulus"), [(8, 256), (4, 16), (2, 4), (1, 2)])
def test_a_palette_is_its_indices_whatever_its_colours(tmp_path: Path, bits: int, modulus: int) -> None:
    ids = np.arange(35).reshape(5, 7) * 3 % modulus
    np.testing.assert_array_equal(read_mask(save_palette(tmp_path / "m.png", ids, bits=bits)), ids)


def test_sixteen_bit_rgb_is_refused(tmp_path: Path, sample: SimpleNamespace) -> None:
    path = sample.save(tmp_path / "m.png", np.full((2, 2, 3), (0, 0, 9), np.uint16))
    with pytest.raises(FrameError, match="3 channels of uint16"):
        read_mask(path)


@pytest.mark.parametrize("folder", ["object_mask", "Annotations"])
def test_masks_beside_the_images_are_found(make_replica: Maker, sample: SimpleNamespace, folder: str) -> None:
    scene = make_replica(3)
    ids = np.full((sample.height, sample.width), 120, np.uint8)
    sample.save(scene / folder / "frame000001.png", ids)
    dataset = open_sequence(scene)
    assert dataset.has_masks
    np.testing.assert_array_equal(dataset[1].mask, ids)
    assert dataset[0].mask is None


@pytest.mark.parametrize("inner", [".", "object_mask", "Annotations"])
def test_masks_named_by_the_user_go_before_those_beside(
    make_replica: Maker, sample: SimpleNamespace, tmp_path: Path, inner: str
) -> None:
    scene = make_replica(1)
    ids = np.ones((sample.height, sample.width), np.uint8)
    sample.save(scene / "object_mask/frame000000.png", ids)
    sample.save(tmp_path / "mine" / inner / "frame000000.png", ids * 2)
    mask = open_dataset(str(scene), data_root=tmp_path, masks=tmp_path / "mine")[0].mask
    assert mask is not None and (mask == 2).all()


def test_masks_beside_are_the_truth_of_others(
    make_replica: Maker, sample: SimpleNamespace, tmp_path: Path
) -> None:
    scene, ids = make_replica(), np.zeros((16, 24), np.uint8)
    sample.save(scene / "object_mask/frame000000.png", ids + 1)
    for i in range(2):
        sample.save(tmp_path / f"mine/frame00000{i}.png", ids + 2)
    dataset = open_sequence(scene, tmp_path / "mine")
    truth = dataset[0].true_mask
    assert truth is not None and (truth == 1).all() and dataset[1].true_mask is None
    for masks in (None, "none", scene, scene / "object_mask"):
        assert open_sequence(scene, masks)[0].true_mask is None


def test_masks_can_be_left_out(make_replica: Maker, sample: SimpleNamespace) -> None:
    scene = make_replica(1)
    sample.save(scene / "object_mask/frame000000.png", np.ones((16, 24), np.uint8))
    dataset = open_dataset(str(scene), data_root=scene, masks="none")
    assert not dataset.has_masks and dataset[0].mask is None


def test_a_named_folder_that_is_absent_or_strange_is_an_error(make_replica: Maker, tmp_path: Path) -> None:
    scene = make_replica(1)
    with pytest.raises(DatasetError, match="absent: no such folder"):
        open_sequence(scene, tmp_path / "absent")
    (tmp_path / "strange").mkdir()
    save_palette(tmp_path / "strange/other.png", IDS)
    with pytest.raises(DatasetError, match=r"strange: holds no mask of any frame.*frame000000\.png"):
        open_sequence(scene, tmp_path / "strange")


def test_a_folder_beside_that_matches_nothing_is_no_masks(make_replica: Maker) -> None:
    scene = make_replica(1)
    save_palette(scene / "object_mask/other.png", IDS)
    assert not open_sequence(scene).has_masks


def test_masks_of_another_size_are_resampled_with_one_warning(
    make_replica: Maker, sample: SimpleNamespace, caplog: pytest.LogCaptureFixture
) -> None:
    scene = make_replica(3)
    small = (np.arange(8 * 12).reshape(8, 12) + 100).astype(np.uint8)
    for i in range(3):
        sample.save(scene / f"object_mask/frame{i:06d}.png", small)
    dataset = open_sequence(scene)
    for i in range(3):
        np.testing.assert_array_equal(dataset[i].mask, np.kron(small, np.ones((2, 2), int)))
        np.testing.assert_array_equal(dataset[i].native_mask, small)
    (note,) = dataset.source.notes
    assert "12x8, but the colour image is 24x16; masks are resampled" in note and not caplog.records


@pytest.mark.parametrize("name", ["{i:05d}", "mask_{i:02d}_v2", "{i}"])
def test_masks_are_found_by_number(make_replica: Maker, sample: SimpleNamespace, name: str) -> None:
    scene = make_replica(4)
    for i in range(4):
        sample.save(scene / f"object_mask/{name.format(i=i)}.png", np.full((16, 24), 10 + i, np.uint8))
    dataset = open_sequence(scene)
    masks = [dataset[i].mask for i in range(4)]
    assert [int(mask[0, 0]) for mask in masks if mask is not None] == [10, 11, 12, 13]
    assert dataset.masks_text == "object_mask/, 4 of 4 frames, by number; one channel"


def test_masks_a_folder_deeper_are_found_unless_several_are(
    make_folder: Maker, sample: SimpleNamespace, tmp_path: Path
) -> None:
    folder = make_folder(2)
    for i in range(2):
        sample.save(tmp_path / f"deva/Annotations/walk/{i}.png", np.full((16, 24), 3, np.uint8))
    (tmp_path / "deva/pred.json").touch()
    dataset = open_dataset(str(folder), data_root=folder, masks=tmp_path / "deva")
    assert dataset[1].mask is not None and (dataset[1].mask == 3).all()
    sample.save(tmp_path / "deva/Annotations/run/0.png", np.full((16, 24), 3, np.uint8))
    with pytest.raises(DatasetError, match=r"several folders in it hold masks .*run, .*walk\); name one"):
        open_dataset(str(folder), data_root=folder, masks=tmp_path / "deva")


def test_grey_saved_as_three_channels_is_the_grey(tmp_path: Path, sample: SimpleNamespace) -> None:
    path = sample.save(tmp_path / "m.png", np.repeat(IDS[..., None], 3, axis=2).astype(np.uint8))
    np.testing.assert_array_equal(read_mask(path), IDS)


def test_void_ids_say_nothing(tmp_path: Path) -> None:
    write_mask(tmp_path / "0.png", np.array([[0, 7, 255], [255, 7, 9]], np.int32))
    masks = find_masks(tmp_path, ["0"], MaskChoice(tmp_path, (255, 9)))
    assert masks is not None
    np.testing.assert_array_equal(masks.read(0), [[0, 7, -1], [-1, 7, -1]])


def test_an_unreadable_mask_costs_the_mask_not_the_frame(
    make_replica: Maker, caplog: pytest.LogCaptureFixture
) -> None:
    scene = make_replica(2)
    path = save_palette(scene / "object_mask/frame000001.png", np.zeros((16, 24), np.uint8))
    path.write_bytes(path.read_bytes()[:-5])
    frame = open_sequence(scene)[1]
    assert frame.mask is None and frame.rgb.shape == (16, 24, 3)
    assert "frame000001.png: is truncated" in caplog.text


def test_an_empty_sequence_has_no_masks(tmp_path: Path) -> None:
    assert find_masks(tmp_path, []) is None


def test_real_masks(recordings: Path) -> None:
    dataset = open_dataset("office0_kf", data_root=recordings)
    mask = dataset[0].mask
    assert dataset.has_masks and mask is not None and mask.shape == (680, 1200)
    assert 10 < len(np.unique(mask)) < 100 and mask.max() < 256
