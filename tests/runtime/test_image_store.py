# SPDX-License-Identifier: Apache-2.0
"""Arrays within a budget come back to the bit, whatever of them is in memory; their file leaves nothing."""

from __future__ import annotations

import io
import logging
import tempfile
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from ggwarp.runtime.image_store import ImageStore
from ggwarp.runtime.streams import to_host

SHAPES = {np.uint8: (48, 64, 3), np.float32: (48, 64), np.int32: (48, 64)}


def images(rng: np.random.Generator, count: int) -> dict[tuple[int, str], np.ndarray]:
    """Colour, depth and labels of so many frames: noise, as that needs most room."""
    found = {}
    for k in range(count):
        for dtype, shape in SHAPES.items():
            found[k, dtype.__name__] = rng.integers(0, 250, shape).astype(dtype)
        found[k, "float32"] *= np.float32(1.0 / 3.0)
    return found


def filled(store: ImageStore, arrays: dict[tuple[int, str], np.ndarray], device: str) -> None:
    for key, array in arrays.items():
        store.put(key, wp.array(array, dtype=wp.dtype_from_numpy(array.dtype), device=device))


@pytest.mark.parametrize("budget", [0, 100_000, None])
def test_arrays_come_back_to_the_bit_within_the_budget(
    device: str, rng: np.random.Generator, tmp_path: Path, budget: int | None
) -> None:
    arrays = images(rng, 12)
    store = ImageStore(device=device, budget=budget, folder=lambda: tmp_path)
    filled(store, arrays, device)
    assert store.keys() == list(arrays) and len(store) == 36 and (3, "int32") in store and 3 not in store
    for number in rng.permutation(200) % 12:
        for key in [key for key in arrays if key[0] == number]:
            array = store.get(key)
            assert str(array.device) == device and to_host(array).dtype == arrays[key].dtype
            np.testing.assert_array_equal(to_host(array), arrays[key])
        most = max(sum(a.nbytes for k, a in arrays.items() if k[0] == 0) + 48 * 64 * 4, budget or 0)
        assert budget is None or store.held <= most
    assert (store.stored > 0) is (budget is not None)
    assert list(tmp_path.iterdir()) == [], "the file has no name"


def test_what_is_changed_is_kept(device: str, rng: np.random.Generator) -> None:
    arrays = images(rng, 6)
    store = ImageStore(device=device, budget=0)
    filled(store, arrays, device)
    for round_ in range(4):
        for k in range(6):
            # Each time noisier, so that it outgrows its place.
            arrays[k, "int32"] = rng.integers(0, 4**round_, (48, 64)).astype(np.int32)
            array = store.get((k, "int32"))
            array.assign(arrays[k, "int32"])
            store.put((k, "int32"), array)
    for key, array in arrays.items():
        np.testing.assert_array_equal(to_host(store.get(key)), array)
    before = store.stored
    for _ in range(3):
        for key in arrays:
            store.get(key)
    assert store.stored == before, "what has not changed is not written again"


def test_an_empty_store_begins_anew(rng: np.random.Generator) -> None:
    store = ImageStore(device="cpu", budget=0)
    filled(store, images(rng, 3), "cpu")
    store.clear()
    assert len(store) == store.held == store.stored == 0
    with pytest.raises(KeyError):
        store.get((0, "int32"))
    arrays = images(rng, 3)
    filled(store, arrays, "cpu")
    np.testing.assert_array_equal(to_host(store.get((0, "uint8"))), arrays[0, "uint8"])


class _FullDisk(io.BytesIO):
    """Takes a few images, then half of one."""

    left = 30_000

    def write(self, data: bytes) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
        taken = min(len(data), self.left)
        self.left -= taken
        return super().write(data[:taken])


def test_a_full_disk_loses_nothing(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: _FullDisk())
    arrays = images(rng, 6)
    store = ImageStore(device="cpu", budget=0)
    with caplog.at_level(logging.WARNING):
        filled(store, arrays, "cpu")
    assert caplog.text.count("stay in memory") == 1 and "No space left" in caplog.text
    for key, array in arrays.items():
        np.testing.assert_array_equal(to_host(store.get(key)), array)


def test_a_missing_folder_and_a_damaged_file_are_said(
    rng: np.random.Generator,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arrays = images(rng, 3)
    store = ImageStore(device="cpu", budget=0, folder=lambda: tmp_path / "gone")
    filled(store, arrays, "cpu")
    assert "gone" in caplog.text and store.held == sum(a.nbytes for a in arrays.values())

    file = io.BytesIO()
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: file)
    store = ImageStore(device="cpu", budget=0)
    filled(store, arrays, "cpu")
    file.getbuffer()[:100] = bytes(100)
    with pytest.raises(OSError, match="damaged"):
        store.get((0, "uint8"))


@pytest.mark.parametrize("budget", [None, 0, 60_000])
def test_arrays_are_joined_where_they_are(device: str, rng: np.random.Generator, budget: int | None) -> None:
    arrays = {("a", k): rng.integers(0, 9, (k, 7, 3)).astype(np.float32) for k in range(1, 40)}
    store = ImageStore(device=device, budget=budget)
    filled(store, arrays, device)
    held, joined = store.held, store.joined(list(arrays))
    assert joined.dtype == np.float32 and joined.shape == (sum(range(1, 40)), 7, 3)
    np.testing.assert_array_equal(np.asarray(joined), np.concatenate(list(arrays.values())))
    assert store.held == held, "nothing is kept"
    filled(store, {("a", 1): np.zeros((1, 7, 3), np.float32)}, device)
    filled(store, {("b", k): np.zeros((30, 7, 3), np.float32) for k in range(40)}, device)
    if budget is not None:
        with pytest.raises(OSError, match="changed since"):
            np.asarray(joined)
