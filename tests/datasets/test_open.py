# SPDX-License-Identifier: Apache-2.0
"""How a sequence is found, by name or path, and what is said when it is not."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ggwarp.datasets import KINDS, Dataset, DatasetError, Kind, open_dataset, register
from ggwarp.datasets.base import MaskChoice, at_scale
from ggwarp.datasets.built_in.faults import SensorFaults
from ggwarp.datasets.formats.mask_file import write_mask
from ggwarp.datasets.readers.tum import full_name

Maker = Callable[..., Path]


def test_a_scene_is_found_by_name_in_a_folder_of_the_data_root(make_replica: Maker, tmp_path: Path) -> None:
    make_replica(2, name="room9")
    dataset = open_dataset("room9", data_root=tmp_path)
    assert isinstance(dataset, Dataset)
    assert (dataset.name, dataset.kind, len(dataset)) == ("room9", "replica", 2)


def test_a_scene_is_found_by_path(make_replica: Maker, tmp_path: Path) -> None:
    scene = make_replica(2)
    assert len(open_dataset(str(scene), data_root=tmp_path / "absent")) == 2


def test_a_relative_path_is_taken_from_here(
    make_replica: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_replica(2)
    monkeypatch.chdir(tmp_path)
    for spelling in ("Replica/scene", "./Replica/scene"):
        assert len(open_dataset(spelling, data_root=tmp_path / "absent")) == 2


def test_a_link_to_a_scene_is_that_scene(make_replica: Maker, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(make_replica(2))
    assert open_dataset(str(tmp_path / "link"), data_root=tmp_path).name == "scene"


def test_any_folder_of_the_root_is_searched(make_replica: Maker, tmp_path: Path) -> None:
    make_replica(2).parent.rename(tmp_path / "My scans")
    assert len(open_dataset("scene", data_root=tmp_path)) == 2


@pytest.mark.parametrize("short", ["fr1/xyz", "fr1_xyz", "freiburg1_xyz", "rgbd_dataset_freiburg1_xyz"])
def test_tum_sequences_go_by_their_short_names(make_tum: Maker, tmp_path: Path, short: str) -> None:
    make_tum([0.0], [0.0], name="rgbd_dataset_freiburg1_xyz")
    assert open_dataset(short, data_root=tmp_path).kind == "tum"


def test_other_names_are_not_tums() -> None:
    assert full_name("office0") is None and full_name("freiburg4_xyz") is None


@pytest.mark.parametrize("seq", ["office0", "office", "synthetic"])
def test_the_built_in_office_needs_no_data(tmp_path: Path, seq: str) -> None:
    dataset = open_dataset(seq, data_root=tmp_path / "absent")
    assert dataset.kind == "synthetic" and dataset.has_masks


def test_the_built_in_scenes_take_faults(tmp_path: Path) -> None:
    for seq in ("office", "wall"):
        good, dark = (
            at_scale(open_dataset(seq, data_root=tmp_path, faults=faults), 0.05)
            for faults in (None, SensorFaults(exposure_drift=0.5))
        )
        assert good.name == dark.name == seq
        last = len(good) * 3 // 4
        assert dark[last].rgb.mean() < 0.7 * good[last].rgb.mean()


def test_the_built_in_office_goes_without_masks_when_told(tmp_path: Path) -> None:
    dataset = open_dataset("office", data_root=tmp_path, masks="none")
    assert not dataset.has_masks and isinstance(dataset, Dataset)
    with pytest.raises(DatasetError, match=r"no mask of any frame .* such as frame000000.png"):
        open_dataset("office", data_root=tmp_path, masks=tmp_path)


def test_the_built_in_office_takes_masks_of_a_folder(tmp_path: Path) -> None:
    ids = np.zeros((680, 1200), np.int32)
    ids[:, 600:] = 99
    write_mask(tmp_path / "frame000001.png", ids)
    dataset = at_scale(open_dataset("office", data_root=tmp_path, masks=tmp_path), 0.05)
    assert isinstance(dataset, Dataset) and dataset.kind == "synthetic" and dataset.camera.width == 60
    mask = dataset[1].mask
    assert mask is not None and mask.shape == (34, 60)
    assert (mask[:, :30] == 0).all() and (mask[:, 30:] == 99).all()
    assert dataset[0].mask is None and dataset[0].rgb.shape == (34, 60, 3)
    truth = dataset[0].true_mask
    assert truth is not None and truth.shape == (34, 60) and 0 < truth.min() < truth.max() < 99


def test_replicas_office0_goes_before_the_built_in_one(make_replica: Maker, tmp_path: Path) -> None:
    make_replica(2, name="office0")
    assert open_dataset("office0", data_root=tmp_path).kind == "replica"
    assert open_dataset("office", data_root=tmp_path).kind == "synthetic"


def test_a_damaged_office0_is_not_replaced_in_silence(tmp_path: Path) -> None:
    (tmp_path / "office0").mkdir()
    with pytest.raises(DatasetError, match="holds no sequence that is recognised"):
        open_dataset("office0", data_root=tmp_path)


def test_an_unknown_name_says_where_it_was_sought(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="room77: no such sequence") as error:
        open_dataset("room77", data_root=tmp_path)
    assert str(tmp_path / "Replica" / "room77") in str(error.value) and "--data" in str(error.value)


def test_void_ids_of_the_built_in_offices_masks(tmp_path: Path) -> None:
    ids = np.full((680, 1200), 7, np.int32)
    ids[:, 600:] = 255
    write_mask(tmp_path / "frame000000.png", ids)
    choice = MaskChoice(tmp_path, (255,))
    frame = at_scale(open_dataset("office", data_root=tmp_path, masks=choice), 0.05)[0]
    assert frame.mask is not None and (frame.mask[:, :30] == 7).all() and (frame.mask[:, 30:] == -1).all()


def test_a_mistyped_name_is_told_the_nearest(make_replica: Maker, tmp_path: Path) -> None:
    make_replica(2, name="kitchen7")
    for typed, meant in (
        ("kichen7", "kitchen7"),
        ("offfice", "office"),
        (str(tmp_path / "Replca"), "Replica"),
    ):
        with pytest.raises(DatasetError, match=rf"no such sequence \(did you mean {meant}\?\); looked for"):
            open_dataset(typed, data_root=tmp_path)
    for number in range(9):
        (tmp_path / f"group{number}").mkdir()
    with pytest.raises(DatasetError, match=r"zzz and 8 places more \(--data"):
        open_dataset("zzz", data_root=tmp_path)


def test_a_file_is_no_sequence(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DatasetError, match=r"is a file; .* or a video \(\.mp4"):
        open_dataset("notes.txt", data_root=tmp_path)


def test_a_kind_can_be_added(tmp_path: Path, make_replica: Maker) -> None:
    scene = open_dataset(str(make_replica(2)), data_root=tmp_path)
    (tmp_path / "special").mkdir()
    register(Kind("special", "special/", lambda path: path.name == "special", lambda path, masks: scene))
    try:
        assert open_dataset("special", data_root=tmp_path) is scene
    finally:
        KINDS.pop()


def test_importing_loads_neither_opencv_nor_warp_nor_torch() -> None:
    code = "import sys, ggwarp.datasets; print([m for m in ('cv2', 'warp', 'torch') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
