# SPDX-License-Identifier: Apache-2.0
"""Archives of arrays that hold something else, or claim to."""

import io
import pickle
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggwarp.io.guarded import CLASSIFIER, FileError
from ggwarp.io.npz import read_arrays


def header(text: str, version: bytes = b"\x01\x00") -> bytes:
    body = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY" + version + len(body).to_bytes(2, "little") + body


def shape(text: str, descr: str = "<f4") -> bytes:
    return header(f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {text}, }}")


def archive(path: Path, content: bytes, method: int = zipfile.ZIP_STORED, name: str = "a.npy") -> Path:
    with zipfile.ZipFile(path, "w", method) as file:
        file.writestr(name, content)
    return path


def test_arrays_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    arrays = {"a": rng.normal(size=(3, 4)), "b": np.asfortranarray(rng.normal(size=(5, 2))), "c": np.zeros(0)}
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "x.npz", **arrays)
        found = read_arrays(tmp_path / "x.npz", CLASSIFIER, dict.fromkeys("abc", "f"))
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].flags.writeable


class Evil:
    def __reduce__(self) -> tuple:
        return (pytest.fail, ("code of the file was run",))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"abc",
        shape("(1000000000000, 16)"),
        shape("(-4, -4)") + bytes(64),
        shape("(1" + "0" * 60 + ",)"),
        shape("(2, 2)") + bytes(15),
        shape("(2, 2)") + bytes(17),
        shape("5"),
        shape("(True,)"),
        shape("[" * 90),
        shape("(1,)", "|O") + pickle.dumps(Evil()),
        shape("(1,)", "<i4") + bytes(4),
        shape("(1,)", "<M8[s]") + bytes(8),
        header("hello"),
        header("{'descr': '<f4'}"),
        b"\x93NUMPY\x07\x00" + bytes(100),
        b"\x93NUMPY\x03\x00" + (1 << 31).to_bytes(4, "little"),
    ],
)
def test_what_is_no_array_is_refused(tmp_path: Path, content: bytes) -> None:
    tracemalloc.start()
    with pytest.raises(FileError, match=r"x\.npz: is no identity classifier \(") as error:
        read_arrays(archive(tmp_path / "x.npz", content), CLASSIFIER, {"a": "f"})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert str(error.value).isprintable() and peak < 32 << 20


def test_what_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    content = shape("(4000000,)") + bytes(16_000_000)
    with pytest.raises(FileError, match="claims 16,000,128 bytes"):
        read_arrays(archive(tmp_path / "x.npz", content, zipfile.ZIP_DEFLATED), CLASSIFIER, {"a": "f"})


@pytest.mark.parametrize("content", [b"", b"PK", np.float32(3).tobytes()])
def test_what_is_no_archive_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(FileError, match="is no identity classifier"):
        read_arrays(tmp_path / "x.npz", CLASSIFIER, {"a": "f"})
    np.save(tmp_path / "x.npy", np.zeros(3))
    with pytest.raises(FileError, match="is no identity classifier"):
        read_arrays(tmp_path / "x.npy", CLASSIFIER, {"a": "f"})


WHOLE = io.BytesIO()
np.savez_compressed(WHOLE, a=np.arange(40.0).reshape(4, 10))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    edits=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), min_size=1, max_size=5),
    keep=st.none() | st.floats(0, 1),
)
def test_any_damage_is_a_file_error(tmp_path: Path, edits: list[tuple[int, int]], keep: float | None) -> None:
    data = bytearray(WHOLE.getvalue() if keep is None else WHOLE.getvalue()[: int(keep * WHOLE.tell())])
    for at, value in edits:
        if data:
            data[at % len(data)] = value
    (tmp_path / "x.npz").write_bytes(data)
    try:
        read_arrays(tmp_path / "x.npz", CLASSIFIER, {"a": "f"})
    except FileError as error:
        assert "x.npz" in str(error) and str(error).isprintable()
