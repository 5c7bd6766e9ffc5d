# SPDX-License-Identifier: Apache-2.0
"""Checkpoints as files: what is written comes back, and what is damaged is told."""

from __future__ import annotations

import json
import struct
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ggwarp.io import checkpoint
from ggwarp.io.checkpoint import read_checkpoint, write_checkpoint
from ggwarp.io.guarded import FileError
from ggwarp.types import StoredArray

TREE: dict[str, Any] = {
    "map": {"means": np.arange(6, dtype=np.float32).reshape(2, 3), "none": np.zeros((0, 16), np.float32)},
    "sampler": {"state": 2**127 + 1, "half": None},
    "list": [np.array([True, False]), 1.5, "text", float("nan"), {"deep": np.array(7, np.int64)}],
}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "c.safetensors"
    write_checkpoint(path, TREE)
    return path


def test_a_tree_comes_back(file: Path) -> None:
    tree = read_checkpoint(file)
    for name, values in TREE["map"].items():
        np.testing.assert_array_equal(tree["map"][name], values, strict=True)
    assert tree["sampler"] == TREE["sampler"]
    assert tree["list"][0].tolist() == [True, False] and tree["list"][1:3] == [1.5, "text"]
    assert np.isnan(tree["list"][3]) and tree["list"][4]["deep"] == 7
    assert list(file.parent.iterdir()) == [file], "and nothing else is left"


def test_arrays_of_every_type_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    kinds = ("?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8")
    tree = {kind: rng.integers(0, 2, (3, 5)).astype(kind)[:, ::2] for kind in kinds}
    write_checkpoint(tmp_path / "c", tree)
    for kind, array in read_checkpoint(tmp_path / "c").items():
        np.testing.assert_array_equal(array, tree[kind], strict=True)


def test_what_is_in_a_file_is_read_part_by_part(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = rng.normal(size=(9, 4)).astype(np.float32)
    alive, counts = [], []

    def parts(cut: int = 9) -> Iterator[np.ndarray]:
        for k in range(0, cut, 3):
            part = rows[k : k + 3].copy()
            alive.append(weakref.ref(part))
            counts.append(sum(one() is not None for one in alive))
            yield part

    stored = StoredArray(rows.dtype, rows.shape, parts)
    path = tmp_path / "c.safetensors"
    write_checkpoint(path, {"a": {"rows": stored}, "b": np.arange(3, dtype=np.int8)})
    assert len(counts) == 3 and max(counts) <= 2, "one after another"
    tree = read_checkpoint(path)
    np.testing.assert_array_equal(tree["a"]["rows"], rows, strict=True)
    np.testing.assert_array_equal(np.asarray(stored), rows, strict=True)
    np.testing.assert_array_equal(tree["b"], [0, 1, 2])
    before = path.read_bytes()
    for wrong in (lambda: parts(6), lambda: iter([rows.astype(np.float64)])):
        with pytest.raises(ValueError, match="rows: "):
            write_checkpoint(path, {"rows": StoredArray(rows.dtype, rows.shape, wrong)})
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_any_damage_is_told(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    for number in range(400):
        damaged = bytearray(data)
        if number % 4 == 0:
            del damaged[rng.integers(len(data)) :]
        else:
            for at in rng.integers(len(data), size=1 + number % 3):
                damaged[at] ^= rng.integers(1, 256)
        file.write_bytes(damaged)
        with pytest.raises(FileError, match="safetensors: "):
            read_checkpoint(file)


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ({}, "is no checkpoint of ggwarp"),
        ({"format": "pt"}, "is no checkpoint of ggwarp"),
        ({"ggwarp": "[" * 100_000}, "is no checkpoint of ggwarp"),
        ({"ggwarp": '{"format": true, "sha256": 3}'}, "is no checkpoint of ggwarp"),
        ({"ggwarp": '{"format": 99, "sha256": ""}'}, "has format 99, which is newer than this ggwarp"),
        ({"ggwarp": '{"format": 0, "sha256": ""}'}, "has format 0, which is older"),
    ],
)
def test_files_of_others_are_refused(tmp_path: Path, header: dict[str, str], reason: str) -> None:
    text = json.dumps({"__metadata__": header} if header else {}).encode()
    path = tmp_path / "c.safetensors"
    path.write_bytes(struct.pack("<Q", len(text)) + text)
    with pytest.raises(FileError, match=reason):
        read_checkpoint(path)


@pytest.mark.parametrize("text", ["[]", "[" * 5000 + "]" * 5000, '{"a": {"$array": "not there"}}', "{"])
def test_sound_files_of_another_content_are_refused(
    tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, real = tmp_path / "c.safetensors", json.dumps
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.json, "dumps", lambda value: text if value == {} else real(value))
        write_checkpoint(path, {})
    with pytest.raises(FileError, match="not as this version writes it"):
        read_checkpoint(path)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for path, reason in ((tmp_path / "none", "cannot be read"), (tmp_path, "is a folder")):
        with pytest.raises(FileError, match=reason):
            read_checkpoint(path)
