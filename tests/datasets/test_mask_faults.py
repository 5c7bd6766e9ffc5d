# SPDX-License-Identifier: Apache-2.0
"""Masks that are none, or not as they should be: other shapes, JPEG, interpolation, pictures."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ggwarp.datasets import DatasetError, open_dataset
from ggwarp.datasets.plan.sequence_plan import plan_sequence
from ggwarp.datasets.source import source_of

Maker = Callable[..., Path]


@pytest.mark.parametrize(
    ("shape", "says"),
    [
        ((24, 16), "16x24, of another shape than the 24x16 images, turned by a quarter"),
        ((16, 16), "16x16, of another"),
    ],
)
def test_masks_of_another_shape_are_refused(
    make_folder: Maker, sample: SimpleNamespace, shape: tuple[int, int], says: str, tmp_path: Path
) -> None:
    folder = make_folder(2)
    for i in range(2):
        sample.save(tmp_path / f"mine/{i}.png", np.ones(shape, np.uint8))
    for masks in (tmp_path / "mine", None):
        with pytest.raises(DatasetError, match=says):
            open_dataset(str(folder), data_root=folder, masks=masks)
        (tmp_path / "mine").rename(folder / "object_mask") if masks else None


def test_one_mask_of_another_shape_costs_that_mask(
    make_folder: Maker, sample: SimpleNamespace, caplog: pytest.LogCaptureFixture
) -> None:
    folder = make_folder(2)
    for i, shape in enumerate([(16, 24), (24, 16)]):
        sample.save(folder / f"object_mask/{i}.png", np.ones(shape, np.uint8))
    dataset = open_dataset(str(folder), data_root=folder)
    assert dataset[0].mask is not None and dataset[1].mask is None and dataset[1].mask is None
    (record,) = caplog.records
    assert "1.png: is 16x24, of another shape" in record.getMessage()


def test_jpeg_masks_are_refused_with_the_reason(
    make_folder: Maker, sample: SimpleNamespace, tmp_path: Path
) -> None:
    folder = make_folder(2)
    for i in range(2):
        sample.save(tmp_path / f"mine/{i}.jpg", np.ones((16, 24), np.uint8))
    with pytest.raises(DatasetError, match=r"\(2 \.jpg\).*JPEG changes ids"):
        open_dataset(str(folder), data_root=folder, masks=tmp_path / "mine")
    (tmp_path / "mine").rename(folder / "object_mask")
    dataset = open_dataset(str(folder), data_root=folder)
    assert not dataset.has_masks
    (note,) = source_of(dataset).notes
    assert "object_mask: holds 2 .jpg, but no PNG with the name or number of an image" in note


def blocks(width: int, height: int) -> np.ndarray:
    """Return a mask of 3 x 2 blocks of ids 10, 20, ... 60."""
    return np.kron(np.arange(10, 70, 10).reshape(2, 3), np.ones((height // 2, width // 3), int)).astype(
        np.uint8
    )


def test_ids_along_edges_of_interpolated_masks_are_none(
    make_folder: Maker, sample: SimpleNamespace, tmp_path: Path
) -> None:
    folder, small = make_folder(3), blocks(12, 8)
    for i in range(3):
        image = cv2.resize(small, (24, 16), interpolation=cv2.INTER_CUBIC)
        assert len(np.unique(image)) > 20
        sample.save(tmp_path / f"mine/{i}.png", image)
    dataset = open_dataset(str(folder), data_root=folder, masks=tmp_path / "mine")
    mask = dataset[0].mask
    assert mask is not None and set(np.unique(mask)) == {-1, 10, 20, 30, 40, 50, 60}
    assert (mask[2:5, 2:6] == 10).all()
    assert any("ids have no pixel inside them" in warning for warning in plan_sequence(dataset).warnings)


def test_thin_objects_alone_are_no_interpolation(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder, ids = make_folder(1), blocks(24, 16)
    ids[3, :], ids[:, 5] = 99, 98
    sample.save(folder / "object_mask/0.png", ids)
    dataset = open_dataset(str(folder), data_root=folder)
    np.testing.assert_array_equal(dataset[0].mask, ids)
    assert not plan_sequence(dataset).warnings


@pytest.mark.parametrize("given", [True, False])
def test_masks_of_which_none_can_be_read_are_refused(
    make_folder: Maker, sample: SimpleNamespace, tmp_path: Path, given: bool
) -> None:
    folder = make_folder(2)
    place = tmp_path / "mine" if given else folder / "object_mask"
    for i in range(2):
        sample.save(place / f"{i}.png", np.full((16, 24, 3), (1, 2, 3), np.uint16))
    with pytest.raises(DatasetError, match=r"0\.png: 3 channels of uint16; RGB-coded.*--masks none"):
        open_dataset(str(folder), data_root=folder, masks=place if given else None)


def test_grey_of_16_bits_saved_as_rgb_is_grey(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(1)
    sample.save(folder / "object_mask/0.png", np.full((16, 24, 3), 700, np.uint16))
    mask = open_dataset(str(folder), data_root=folder)[0].mask
    assert mask is not None and (mask == 700).all()


def test_folders_that_look_like_masks_are_named(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(2)
    for i in range(2):
        sample.save(folder / f"instance/{i}.png", np.ones((16, 24), np.uint8))
        sample.save(folder / f"rest/{i}.png", np.ones((16, 24), np.uint8))
    dataset = open_dataset(str(folder), data_root=folder)
    (note,) = source_of(dataset).notes
    assert "instance: is not read; masks are looked for in object_mask/ and Annotations/" in note
    for masks in ("none", str(folder / "instance")):
        assert not source_of(open_dataset(str(folder), data_root=folder, masks=masks)).notes


def test_fewer_masks_than_images_from_the_same_number_are_doubted(
    make_folder: Maker, sample: SimpleNamespace
) -> None:
    folder = make_folder(6)
    for i in range(3):
        sample.save(folder / f"object_mask/{i}.png", np.ones((16, 24), np.uint8))
    (note,) = source_of(open_dataset(str(folder), data_root=folder)).notes
    assert "6 images and 3 masks, both numbered from 0 without gaps" in note


def test_pictures_in_the_place_of_masks_are_refused(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(1)
    ids = np.arange(80 * 120).reshape(80, 120)
    bgr = np.stack([ids >> 16, (ids >> 8) & 255, ids & 255], axis=-1).astype(np.uint8)
    sample.save(folder / "object_mask/0.png", bgr)
    with pytest.raises(DatasetError, match=r"holds 9600 ids, more than 480: is it a .*--masks none"):
        open_dataset(str(folder), data_root=folder)


@pytest.mark.parametrize("step", [1, 3])
def test_a_picture_in_a_masks_place_is_left_aside_with_one_warning(
    make_folder: Maker, sample: SimpleNamespace, caplog: pytest.LogCaptureFixture, step: int
) -> None:
    """As many ids as pixels, or one per three of them; at most 256 are always taken."""
    folder = make_folder(3)
    ids = (np.arange(80 * 120) // step).reshape(80, 120)
    for i in range(2):
        bgr = np.stack([ids >> 16, (ids >> 8) & 255, ids & 255], axis=-1).astype(np.uint8)
        sample.save(folder / f"object_mask/{i}.png", bgr)
    sample.save(folder / "object_mask/2.png", (ids[:16, :24] % 256).astype(np.uint8))
    dataset = open_dataset(str(folder), data_root=folder)
    masks = [dataset[i].mask for i in range(3)]
    assert masks[0] is None and masks[1] is None and masks[2] is not None
    (record,) = caplog.records
    assert f"holds {len(np.unique(ids))} ids, more than 480: is it a picture of ids?" in record.getMessage()


def test_large_ids_are_not_many_ids(make_folder: Maker, sample: SimpleNamespace) -> None:
    folder = make_folder(1)
    bgr = np.full((16, 24, 3), 255, np.uint8)
    bgr[:, :12], bgr[:, 18:, 2] = 0, 254
    sample.save(folder / "object_mask/0.png", bgr)
    mask = open_dataset(str(folder), data_root=folder)[0].mask
    assert mask is not None and set(np.unique(mask)) == {0, (1 << 24) - 2, (1 << 24) - 1}
