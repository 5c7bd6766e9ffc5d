# SPDX-License-Identifier: Apache-2.0
"""Masks of other frames, ids that change and ids that mean no label are told; good masks are not doubted."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ggwarp.datasets import open_dataset
from ggwarp.datasets.base import at_scale
from ggwarp.datasets.plan.mask_checks import mask_doubts
from ggwarp.types import Frame

Change = Callable[[int, np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    office = at_scale(open_dataset("office", data_root=Path("absent")), 0.25)
    return [office[i] for i in range(16)]


def said(frames: list[Frame], masks: list[np.ndarray], *, tracked: bool = True) -> list[str]:
    pictures = {i: frames[i].rgb for i in range(2, 13, 2)}
    return list(mask_doubts(pictures, dict(enumerate(masks)), tracked=tracked))


def masks_of(frames: list[Frame]) -> list[np.ndarray]:
    return [frame.mask for frame in frames if frame.mask is not None]


def renumbered(masks: list[np.ndarray]) -> list[np.ndarray]:
    """Return masks whose ids are dealt out anew in each; 0 stays."""
    chance = np.random.default_rng(0)
    names = np.unique(masks)
    tables = [np.concatenate([[0], 1 + chance.permutation(len(names) - 1)]) for _ in masks]
    return [table[np.searchsorted(names, mask)] for table, mask in zip(tables, masks, strict=True)]


def test_good_masks_are_not_doubted(frames: list[Frame]) -> None:
    masks = masks_of(frames)
    assert said(frames, masks) == []
    assert said(frames, [np.where(mask == 0, -1, mask) for mask in masks]) == [], "void meets nothing"
    assert said(frames, []) == []


@pytest.mark.parametrize(("shift", "name"), [(2, "2 frames earlier"), (-1, "1 frame later")])
def test_masks_of_other_frames_are_named(frames: list[Frame], shift: int, name: str) -> None:
    masks = masks_of(frames)
    (doubt,) = said(frames, [masks[min(max(i + shift, 0), 15)] for i in range(16)])
    assert doubt.startswith(f"the mask of {name} fits the pictures better than their own")


def test_mirrored_masks_are_told(frames: list[Frame]) -> None:
    (doubt,) = said(frames, [mask[:, ::-1] for mask in masks_of(frames)])
    assert doubt.startswith("edges of the mask do not lie on edges of the pictures")
    assert "registered" not in doubt


def test_ids_of_single_images_are_told_from_tracked_ones(frames: list[Frame]) -> None:
    masks = renumbered(masks_of(frames))
    (doubt,) = said(frames, masks)
    assert doubt.startswith("ids change from frame to frame") and "--masks-kind untracked" in doubt
    assert said(frames, masks, tracked=False) == []


def test_ids_that_a_fast_camera_mixes_are_tracked(frames: list[Frame]) -> None:
    """Neighbours ten frames apart: few ids stay in their place, and no renaming explains it."""
    office = at_scale(open_dataset("office", data_root=Path("absent")), 0.25)
    far = [office[i] for i in range(0, 120, 10)]
    pictures = {i: far[i].rgb for i in range(11)}
    assert list(mask_doubts(pictures, dict(enumerate(masks_of(far))))) == []


def test_an_id_of_no_label_is_named(frames: list[Frame]) -> None:
    masks = [mask.copy() for mask in masks_of(frames)]
    for mask in masks:
        mask[:20] = 255
    (doubt,) = said(frames, masks)
    assert doubt.startswith("id 255 stands beside ids up to") and "--masks-void 255" in doubt
    full = [np.where(mask > 40, 200, mask) for mask in masks]
    assert said(frames, full) == [], "ids up to 255 may be of objects"
    assert said(frames, [np.where(mask > 0, 255, 0) for mask in masks]) == [], "one object may be white"
