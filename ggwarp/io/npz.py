# SPDX-License-Identifier: Apache-2.0
"""NumPy archives of somebody else's: arrays of known kinds, and nothing else, are taken out of them."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ggwarp.io.guarded import FileError, FileKind, open_file
from ggwarp.io.printable import printable

_HEADER_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_arrays(path: str | Path, kind: FileKind, wanted: Mapping[str, str]) -> dict[str, NDArray[Any]]:
    """Return the arrays named in ``wanted``.

    Nothing is allocated before an array's header has been compared with the bytes that are there, and no
    pickle is ever loaded.

    Args:
        wanted: name -> the kinds of numbers that it may hold, in NumPy's letters: "f", "iu", ...

    Raises:
        FileError: the file is missing, damaged, or lacks an array of that name and kind; an array claims more
            bytes than ``kind`` allows.
    """
    with open_file(path, kind) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                return {name: _read_array(archive, name, wanted[name], kind.limit) for name in wanted}
        except MemoryError:
            raise
        # Whatever zipfile, its decompressors and NumPy raise for damaged bytes: a dozen types.
        except Exception as error:
            reason = printable(str(error)) or type(error).__name__
            what = kind.name.split(" ", 1)[1]
            raise FileError(f"{printable(str(path))}: is no {what} ({reason})") from None


def _read_array(archive: zipfile.ZipFile, name: str, kind: str, limit: int) -> NDArray[Any]:
    entry = archive.getinfo(f"{name}.npy")
    if entry.file_size > limit:
        raise ValueError(f"{name} claims {entry.file_size:,} bytes")
    with archive.open(entry) as stream:
        return _parse(stream, name, kind, limit)  # pyright: ignore[reportArgumentType]


def _parse(stream: BinaryIO, name: str, kind: str, limit: int) -> NDArray[Any]:
    version = npy.read_magic(stream)
    if version not in _HEADER_READERS:
        raise ValueError(f"{name} has the unknown version {version}")
    shape, fortran, dtype = _HEADER_READERS[version](stream)
    if dtype.hasobject or dtype.kind not in kind:
        raise ValueError(f"{name} holds {dtype}")
    size = dtype.itemsize
    for side in shape:
        size *= side
    if not 0 <= size <= limit:
        raise ValueError(f"{name} claims {size:,} bytes")
    data = stream.read(size + 1)
    if len(data) != size:
        raise ValueError(f"{name} is cut short, or goes on")
    flat = np.frombuffer(data, dtype)
    return flat.reshape(shape, order="F" if fortran else "C").copy()
