# SPDX-License-Identifier: Apache-2.0
"""Archives unpacked: all or nothing, nowhere else, and never more than the disk has room for."""

from __future__ import annotations

import errno
import gzip
import lzma
import os
import shutil
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Any

from ggwarp.io.printable import printable, shortened

_CHUNK = 1 << 20
_RESERVE = 64 << 20
"""Bytes of the disk that are left alone."""
_DEEPEST = 32
"""Folders in folders that an archive may hold."""
_EXTRA_HEADER = 1 << 20
"""Bytes of a tar header beside the plain one, which hold long names and the like; they are read as one."""
_EXTRA_TYPES = (b"x", b"g", b"X", b"L", b"K")
_DAMAGE = (
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, struct.error, EOFError),
    *(RuntimeError, ValueError, LookupError, ArithmeticError, MemoryError),
)
"""What the standard library raises for damaged archives, and for what it cannot undo (codes, methods)."""


class DownloadError(Exception):
    """The sequence cannot be fetched: one line with the address, what happened and what to do."""


class NoRoomError(DownloadError):
    """The disk has too little room; what was fetched so far is good."""


def check_room(folder: Path, size: int) -> None:
    """Refuse to write ``size`` more bytes to ``folder`` when its disk would be full afterwards."""
    free = shutil.disk_usage(folder).free
    if size + _RESERVE > free:
        raise NoRoomError(
            f"{folder}: {size:,} bytes more are needed, and {free:,} are free; make room there, or name "
            "another place with --data, and run the same command again"
        )


def unpack(archive: Path, folder: Path, *, wanted: tuple[str, ...], needed: Path) -> None:
    """Unpack an archive under ``folder``, all or nothing.

    Args:
        wanted: only paths that begin with one of these; empty = all.
        needed: the folder that must have come out of it.

    Raises:
        DownloadError: it is damaged, would write outside ``folder``, or lacks what is needed.
        NoRoomError: the disk has no room for it.
    """
    staging = folder / f".{archive.name}.unpacking"
    shutil.rmtree(staging, ignore_errors=True)
    try:
        for name, content in _members(archive):
            path = PurePosixPath(name)
            outside = path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name
            if outside or len(path.parts) > _DEEPEST:
                raise DownloadError(f"{archive}: holds the unsafe path {name!r}; nothing was unpacked")
            if wanted and not name.startswith(wanted):
                continue
            target = staging / path
            target.parent.mkdir(parents=True, exist_ok=True)
            with open(target, "wb") as file:
                while chunk := content.read(_CHUNK):
                    check_room(folder, len(chunk))
                    file.write(chunk)
        if not (staging / needed.relative_to(folder)).is_dir():
            raise DownloadError(f"{archive}: holds no {needed.relative_to(folder)}")
        _merge(staging, folder)
    except (*_DAMAGE, OSError) as error:
        # To seek where nothing is, as a damaged list of contents asks for, is an invalid argument.
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise  # the disk's, not the archive's
        reason = shortened(printable(f"{type(error).__name__}: {error}".removesuffix(": ")))
        raise DownloadError(
            f"{archive}: is damaged ({reason}); run the same command to fetch it again"
        ) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _members(archive: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Yield (path, content) of an archive's plain files; reading to the end verifies checksums."""
    if archive.suffix == ".zip":
        with zipfile.ZipFile(archive) as zipped:
            for entry in zipped.infolist():
                if not entry.is_dir():
                    with zipped.open(entry) as content:
                        yield entry.filename, content
        return
    with gzip.open(archive) as stream:
        limit = shutil.disk_usage(archive.parent).free
        bounded: Any = _BoundedStream(stream, archive, limit)
        with tarfile.open(fileobj=bounded, mode="r|", tarinfo=_Member) as tar:
            while (member := tar.next()) is not None:
                vars(tar)["members"] = []  # else it keeps every one
                content = tar.extractfile(member) if member.isfile() else None
                if content is not None:
                    yield member.name.removeprefix("./"), content
                elif not member.isdir():
                    raise DownloadError(
                        f"{archive}: holds the unsafe path {member.name!r} (a link or device)"
                    )
        # The checksum lies behind the padding that the tar reader leaves.
        while bounded.read(_CHUNK):
            pass


class _Member(tarfile.TarInfo):
    """A tar header that claims no more than one can be."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> _Member:
        member = super().frombuf(buf, encoding, errors)
        if member.type in _EXTRA_TYPES and not 0 <= member.size <= _EXTRA_HEADER:
            raise tarfile.ReadError(f"a header of {member.size:,} bytes")
        return member


class _BoundedStream:
    """What is unpacked of an archive, up to the room that there is."""

    def __init__(self, stream: Any, archive: Path, limit: int) -> None:
        self._stream, self._archive, self._left = stream, archive, limit

    def read(self, size: int) -> bytes:
        data = self._stream.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise NoRoomError(f"{self._archive}: holds more than the disk has room for")
        return data


def _merge(source: Path, target: Path) -> None:
    """Move what is in ``source`` into ``target``; files there already are replaced."""
    for child in source.iterdir():
        if child.is_dir() and (target / child.name).is_dir():
            _merge(child, target / child.name)
        else:
            os.replace(child, target / child.name)
