# SPDX-License-Identifier: Apache-2.0
"""ggwarp segment: what a segmenter says is what a run reads. No weights are needed."""

import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ggwarp.commands import segment
from ggwarp.datasets import open_dataset
from ggwarp.datasets.formats.mask_file import read_mask

SHAPE = (30, 40)


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Three frames with a bright square that moves."""
    folder = tmp_path / "seq"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    (folder / "camera.json").write_text(
        '{"w": 40, "h": 30, "fx": 30, "fy": 30, "cx": 19.5, "cy": 14.5, "scale": 1000}'
    )
    for i in range(3):
        rgb = np.zeros((*SHAPE, 3), np.uint8)
        rgb[5:15, 5 + 4 * i : 15 + 4 * i] = 255
        cv2.imwrite(str(folder / "rgb" / f"{i:04d}.png"), rgb)
        cv2.imwrite(str(folder / "depth" / f"{i:04d}.png"), np.full(SHAPE, 1000, np.uint16))
    return folder


def bright(rgb: np.ndarray) -> np.ndarray:
    """Call what is bright 7: a segmenter."""
    return np.where(rgb[..., 0] > 128, 7, 0)


def test_later_segments_lie_over_earlier_ones_and_small_ones_are_left_out() -> None:
    masks = np.zeros((3, *SHAPE), bool)
    masks[0, :20], masks[1, 10:12, :20], masks[2, 0, :3] = True, True, True
    ids = segment.painted(masks, SHAPE, least_area=10)
    assert np.bincount(ids.ravel()).tolist() == [400, 760, 40]


def test_ones_own_segmenter_writes_masks_that_a_run_reads(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mine", SimpleNamespace(segment=bright))
    out = tmp_path / "masks"
    assert segment.main([str(sequence), str(out), "--model", "mine:segment"]) == 0
    dataset = open_dataset(str(sequence), data_root=tmp_path, masks=out)
    for i in range(3):
        mask = dataset[i].mask
        assert mask is not None
        np.testing.assert_array_equal(mask, bright(dataset[i].rgb))
        assert (mask == 7).sum() == 100


def test_the_built_in_office_is_segmented_too(tmp_path: Path) -> None:
    dataset = open_dataset("office", data_root=tmp_path, masks="none")
    out = tmp_path / "masks"
    assert segment.write_masks(dataset, bright, out, step=len(dataset) - 1) == 2
    assert open_dataset("office", data_root=tmp_path, masks=out)[0].mask is not None


def test_every_second_frame(sequence: Path, tmp_path: Path) -> None:
    dataset = open_dataset(str(sequence), data_root=tmp_path)
    assert segment.write_masks(dataset, bright, tmp_path / "masks", step=2) == 2
    assert sorted(path.stem for path in (tmp_path / "masks").iterdir()) == ["0000", "0002"]
    assert read_mask(tmp_path / "masks" / "0002.png").max() == 7


def test_mask_rcnn_keeps_the_sure_with_the_surest_on_top() -> None:
    torch = pytest.importorskip("torch")

    class Detector(torch.nn.Module):
        def forward(self, images):
            assert images[0].shape == (3, *SHAPE) and 0.0 <= images[0].min() and images[0].max() == 1.0
            masks = torch.zeros(3, 1, *SHAPE)
            masks[0, 0, :10], masks[1, 0, 5:20], masks[2, 0, 20:] = 0.9, 0.8, 0.9
            return [{"scores": torch.tensor([0.9, 0.6, 0.3]), "masks": masks}]

    ids = segment.mask_rcnn("cpu", model=Detector())(np.full((*SHAPE, 3), 255, np.uint8))
    top, middle, rest = ids[:10], ids[10:20], ids[20:]
    assert len(np.unique(top)) == len(np.unique(middle)) == 1 and not (rest > 0).any()
    assert top[0, 0] != middle[0, 0] and top.min() > 0 and middle.min() > 0


def test_sam2_lays_small_segments_over_large_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    large, small = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    large[:20], small[5:15, 5:20] = True, True
    records = [{"segmentation": small}, {"segmentation": large}]
    generator = SimpleNamespace(
        from_pretrained=lambda name, device: SimpleNamespace(generate=lambda rgb: records)
    )
    fake = SimpleNamespace(SAM2AutomaticMaskGenerator=generator)
    monkeypatch.setitem(sys.modules, "sam2", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "sam2.automatic_mask_generator", fake)
    ids = segment.load_segmenter("sam2", "cpu")(np.zeros((*SHAPE, 3), np.uint8))
    assert sorted(np.bincount(ids.ravel()).tolist()) == [150, 400, 650]
    assert len(np.unique(ids[small])) == 1 and ids[0, 0] != ids[5, 5]


def test_says_what_is_wrong(sequence: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    def said(*arguments: str) -> str:
        assert segment.main([str(sequence), *arguments]) == 2
        return capsys.readouterr().err

    out = str(tmp_path / "masks")
    assert "MODULE:FUNCTION" in said(out, "--model", "yolo")
    monkeypatch.setitem(sys.modules, "sam2", None)
    assert "install sam2" in said(out, "--model", "sam2")
    wrong = SimpleNamespace(flat=lambda rgb: np.zeros(12), of=3)
    monkeypatch.setitem(sys.modules, "wrong", wrong)
    assert "has no function of" in said(out, "--model", "wrong:of")
    assert "[h, w] integers" in said(out, "--model", "wrong:flat")
    monkeypatch.setitem(sys.modules, "mine", SimpleNamespace(segment=bright))
    assert "is not empty" in said(str(sequence), "--model", "mine:segment")
