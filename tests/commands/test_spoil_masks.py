# SPDX-License-Identifier: Apache-2.0
"""ggwarp spoil-masks: what it writes is what a run reads, and the same every time."""

from pathlib import Path

import numpy as np
import pytest

from ggwarp.commands import spoil_masks
from ggwarp.datasets.built_in.faults import MaskFaults, changed_names, faulty_mask, shared_names
from ggwarp.datasets.formats.mask_file import read_mask, write_mask


@pytest.fixture
def clean(tmp_path: Path) -> Path:
    folder = tmp_path / "seq" / "object_mask"
    folder.mkdir(parents=True)
    mask = np.zeros((40, 60), np.int32)
    mask[5:30, 5:25], mask[10:35, 30:55] = 7, 300
    for i in range(30):
        write_mask(folder / f"frame{i:04d}.png", mask)
    return folder


OPTIONS = ["--dots", "0.05", "--ragged", "3", "--missing", "0.2", "--swapped", "0.1", "--seed", "4"]


@pytest.mark.parametrize("source", ["masks", "sequence"])
def test_writes_the_faults_of_the_data_sets(clean: Path, tmp_path: Path, source: str) -> None:
    given = clean if source == "masks" else clean.parent
    out = tmp_path / "out"
    assert spoil_masks.main([str(given), str(out), *OPTIONS]) == 0
    faults = MaskFaults(dots=0.05, ragged=3, missing=0.2, swapped=0.1, seed=4)
    written = {path.stem for path in out.iterdir()}
    assert 18 <= len(written) < 30
    for i, path in enumerate(sorted(clean.iterdir())):
        want = faulty_mask(read_mask(path), faults, i, np.array([7, 300], np.int32))
        assert (want is None) == (path.stem not in written)
        if want is not None:
            np.testing.assert_array_equal(read_mask(out / path.name), want)


def test_tracks_break_for_good(clean: Path, tmp_path: Path) -> None:
    """Up to frame 10 as they were; from there on 300 carries 7's id, or both carry new ones."""
    for name, want in (("stolen", {7: 301, 300: 7}), ("reborn", {7: 301, 300: 302})):
        out = tmp_path / name
        assert spoil_masks.main([str(clean), str(out), f"--{name}", "0.999", "--changed-at", "10"]) == 0
        for i, path in enumerate(sorted(clean.iterdir())):
            given, got = read_mask(path), read_mask(out / path.name)
            for old, new in want.items():
                assert np.unique(got[given == old]).tolist() == [old if i < 10 else new], (name, i)


def test_no_two_objects_share_an_id_after_a_break() -> None:
    ids = np.arange(1, 200, dtype=np.int32)
    for seed in range(5):
        names = changed_names(ids, 0.2, 0.3, np.random.default_rng(seed))
        assert 40 < len(names) < 160
        assert len({names.get(i, i) for i in ids.tolist()}) == len(ids)
    assert changed_names(ids, 0.0, 0.0, np.random.default_rng(0)) == {}


def test_says_what_is_wrong(clean: Path, tmp_path: Path, capsys) -> None:
    assert spoil_masks.main([str(clean), str(clean)]) == 2
    assert "is not empty" in capsys.readouterr().err
    assert spoil_masks.main([str(tmp_path / "absent"), str(tmp_path / "out")]) == 2
    assert "no such sequence" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        spoil_masks.main([str(clean), str(tmp_path / "out"), "--dots", "5"])


def test_shared_ids_are_another_object_s_in_every_frame(rng: np.random.Generator) -> None:
    ids = np.array([3, 7, 20, 21, 300], np.int32)
    for seed in range(50):
        names = shared_names(ids, 0.5, np.random.default_rng(seed))
        assert not set(names) & set(names.values()) and set(names.values()) <= set(ids.tolist())
    assert shared_names(ids, 0.0, rng) == {}
    assert shared_names(ids[:1], 0.9, rng) == {}
    mask = rng.choice(ids, (20, 30)).astype(np.int32)
    names = shared_names(ids, 0.5, np.random.default_rng([4, 5]))
    assert names
    for index in (0, 9):
        out = faulty_mask(mask, MaskFaults(shared=0.5, seed=4), index, ids)
        for old in ids.tolist():
            assert (out[mask == old] == names.get(old, old)).all()
