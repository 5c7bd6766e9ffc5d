# SPDX-License-Identifier: Apache-2.0
"""Archives that lie, and archives that never end."""

import bz2
import gzip
import io
import lzma
import shutil
import struct
import tarfile
import tracemalloc
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggwarp.commands.archives import DownloadError, NoRoomError, unpack

CONTENT = bytes(range(256)) * 40


def make_zip(method: int = zipfile.ZIP_DEFLATED, name: str = "seq/a.txt") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        archive.writestr(name, CONTENT)
    return buffer.getvalue()


def make_tar(name: str = "seq/a.txt", *, size: int | None = None, kind: bytes = tarfile.REGTYPE) -> bytes:
    """One member, with its header saying ``size`` and ``kind``, not yet compressed."""
    member = tarfile.TarInfo(name)
    member.size, member.type = len(CONTENT) if size is None else size, kind
    padded = CONTENT + bytes(-len(CONTENT) % 512)
    return member.tobuf(tarfile.GNU_FORMAT) + padded + bytes(1024)


def change_method(data: bytes, method: int) -> bytes:
    """Return a zip whose two headers name another way of compression."""
    out = bytearray(data)
    struct.pack_into("<H", out, 8, method)
    struct.pack_into("<H", out, data.index(b"PK\x01\x02") + 10, method)
    return bytes(out)


def encrypt(data: bytes) -> bytes:
    out = bytearray(data)
    out[6] |= 1
    out[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(out)


def spoil(data: bytes, at: int = 60) -> bytes:
    return data[:at] + bytes(b ^ 255 for b in data[at : at + 20]) + data[at + 20 :]


def attempt(folder: Path, data: bytes, suffix: str) -> None:
    archive = folder / f"x{suffix}"
    archive.write_bytes(data)
    unpack(archive, folder, wanted=(), needed=folder / "seq")


DAMAGED = {
    "encrypted": (encrypt(make_zip()), ".zip"),
    "unknown method": (change_method(make_zip(), 99), ".zip"),
    "LZMA": (spoil(make_zip(zipfile.ZIP_LZMA)), ".zip"),
    "bzip2": (spoil(make_zip(zipfile.ZIP_BZIP2)), ".zip"),
    "LZMA that is none": (change_method(make_zip(), 14), ".zip"),
    "bzip2 that is none": (change_method(make_zip(), 12), ".zip"),
    "deflate": (spoil(make_zip()), ".zip"),
    "bz2, not gz": (bz2.compress(make_tar()), ".tgz"),
    "xz, not gz": (lzma.compress(make_tar()), ".tgz"),
    "a pax header of 3 GB": (gzip.compress(make_tar(size=3 << 30, kind=b"x")), ".tgz"),
    "a global header of 3 GB": (gzip.compress(make_tar(size=3 << 30, kind=b"g")), ".tgz"),
    "a name of 3 GB": (gzip.compress(make_tar(size=3 << 30, kind=b"L")), ".tgz"),
    "a link's name of 3 GB": (gzip.compress(make_tar(size=3 << 30, kind=b"K")), ".tgz"),
    "a header for ever": (gzip.compress(make_tar(size=512, kind=b"x")[:1024] * 3000), ".tgz"),
    "a negative size": (gzip.compress(make_tar(size=-1, kind=b"x")), ".tgz"),
    "longer than it is": (gzip.compress(make_tar(size=1 << 40)), ".tgz"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damage_is_one_line_and_leaves_nothing(tmp_path: Path, case: str) -> None:
    tracemalloc.start()
    with pytest.raises(DownloadError, match=r"is damaged \(.*run the same command") as error:
        attempt(tmp_path, *DAMAGED[case])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "\n" not in str(error.value) and peak < 64 << 20
    assert len(list(tmp_path.iterdir())) == 1


def zeros_for_ever(name: str, size: int) -> bytes:
    """A tar of ``size`` zeros: a thousandth of it on the disk."""
    member = tarfile.TarInfo(name)
    member.size = size
    return gzip.compress(member.tobuf() + bytes(size + 1024))


@pytest.mark.parametrize("suffix", [".zip", ".tgz"])
def test_no_more_is_unpacked_than_there_is_room_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    size, free = 24 << 20, 80 << 20
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("seq/a", bytes(size))
    data = buffer.getvalue() if suffix == ".zip" else zeros_for_ever("seq/a", size)

    def usage(_: object) -> SimpleNamespace:
        used = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
        return SimpleNamespace(free=free - used)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    with pytest.raises(NoRoomError):
        attempt(tmp_path, data, suffix)
    assert [path.name for path in tmp_path.iterdir()] == [f"x{suffix}"]


def test_what_is_only_padding_is_bounded_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=65 << 20))
    padded = gzip.compress(make_tar()) + gzip.compress(bytes(70 << 20))
    with pytest.raises(NoRoomError, match="more than the disk has room for"):
        attempt(tmp_path, padded, ".tgz")


def test_many_members_cost_no_memory(tmp_path: Path) -> None:
    folders = b"".join(make_tar(f"seq/{i}", size=0, kind=tarfile.DIRTYPE)[:512] for i in range(6000))
    data = gzip.compress(make_tar()[:-1024] + folders + bytes(1024))
    tracemalloc.start()
    attempt(tmp_path, data, ".tgz")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 << 20 and (tmp_path / "seq/a.txt").read_bytes() == CONTENT


def test_folders_in_folders_without_end_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match="unsafe path"):
        attempt(tmp_path, make_zip(name="seq/" + "a/" * 1500 + "b"), ".zip")


@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(["zip", "lzma zip", "tar"]),
    edits=st.lists(st.tuples(st.integers(0, 700), st.integers(0, 255)), min_size=1, max_size=4),
    keep=st.none() | st.floats(0, 1),
)
def test_any_damage_is_a_download_error(
    tmp_path: Path, kind: str, edits: list[tuple[int, int]], keep: float | None
) -> None:
    """The tar is damaged before it is compressed, so that its headers are what is tried."""
    whole = make_tar() if kind == "tar" else make_zip(*([zipfile.ZIP_LZMA] if kind == "lzma zip" else []))
    data = bytearray(whole if keep is None else whole[: int(keep * len(whole))])
    for at, value in edits:
        if data:
            data[at % len(data)] = value
    if kind == "tar" and len(data) >= 512:  # its checksum made good again
        data[148:156] = b" " * 8
        data[148:156] = b"%06o\0 " % sum(data[:512])
    try:
        if kind == "tar":
            attempt(tmp_path, gzip.compress(bytes(data)), ".tgz")
        else:
            attempt(tmp_path, bytes(data), ".zip")
    except DownloadError as error:
        assert "\n" not in str(error)
    except OSError as error:  # such as a name that no file can have
        assert error.errno is not None
