# SPDX-License-Identifier: Apache-2.0
"""A checkpoint as one file: arrays (safetensors) and JSON, versioned, with a checksum; no pickle."""

from __future__ import annotations

import hashlib
import json
import math
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ggwarp.io.atomic import atomic_write
from ggwarp.io.guarded import FileError, FileKind, check_file
from ggwarp.io.printable import printable, shown
from ggwarp.types import StoredArray

FORMAT = 5
"""Grows when what a checkpoint holds changes, so that an older version would not understand it."""

_CHECKPOINT = FileKind("a checkpoint", 64 << 30)
_ARRAY = "$array"
_DEEPEST = 64
_KINDS = {"b1": "BOOL", "f2": "F16", "f4": "F32", "f8": "F64"} | {
    f"{kind}{size}": f"{kind.upper()}{8 * size}" for kind in "iu" for size in (1, 2, 4, 8)
}
"""NumPy's types as safetensors names them."""


def write_checkpoint(path: Path, tree: dict[str, Any]) -> None:
    """Write ``tree``: dictionaries with text for keys, lists, arrays and JSON's values.

    What is in other files is read part by part, never all of it at once. The file is on the disk, whole,
    before it has its name.

    Raises:
        OSError: it cannot be written.
    """
    arrays: dict[str, NDArray[Any] | StoredArray] = {}
    text = json.dumps(_without_arrays(tree, "", arrays))
    entries, end = {}, 0
    for name in sorted(arrays):
        array = arrays[name]
        begin, end = end, end + math.prod(array.shape) * array.dtype.itemsize
        kind = _KINDS[array.dtype.newbyteorder("=").str[1:]]
        entries[name] = {"dtype": kind, "shape": list(array.shape), "data_offsets": [begin, end]}
    digest = _begun(text)
    with atomic_write(path) as file:
        file.write(_header(text, entries, "0" * len(digest.hexdigest())))
        for name in entries:
            _write_array(file, digest, name, arrays[name])
        file.seek(0)
        file.write(_header(text, entries, digest.hexdigest()))


def _header(text: str, entries: dict[str, Any], checksum: str) -> bytes:
    """Return what a file of safetensors begins with, the values that are no arrays among it."""
    said = {"ggwarp": json.dumps({"format": FORMAT, "sha256": checksum}), "values": text}
    header = json.dumps({"__metadata__": said, **entries}).encode()
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header


def _write_array(file: BinaryIO, digest: Any, name: str, array: NDArray[Any] | StoredArray) -> None:
    """Write an array part by part, and take it into the checksum."""
    digest.update(_named(name, array))
    size = 0
    for part in array.parts() if isinstance(array, StoredArray) else [array]:
        if part.dtype != array.dtype or part.shape[1:] != array.shape[1:]:
            raise ValueError(f"{name}: a part of it is not like it")
        data = np.ascontiguousarray(part).tobytes()
        file.write(data)
        digest.update(data)
        size += len(data)
    if size != math.prod(array.shape) * array.dtype.itemsize:
        raise ValueError(f"{name}: its parts are not as long as it")


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read what :func:`write_checkpoint` wrote.

    Raises:
        FileError: the file is missing or damaged, of a newer version, or no checkpoint.
    """
    from safetensors import SafetensorError, safe_open

    name = printable(str(path))
    check_file(path, _CHECKPOINT)
    try:
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            _check_version(name, header)
            arrays = {key: file.get_tensor(key) for key in file.keys()}
    except FileError:
        raise
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise FileError(f"{name}: is damaged, or no checkpoint ({printable(str(error))})") from None
    text = header.get("values", "")
    if json.loads(header["ggwarp"])["sha256"] != _checksum(text, arrays):
        raise FileError(f"{name}: is damaged: its checksum is another")
    try:
        tree = _with_arrays(json.loads(text), arrays)
    except (ValueError, KeyError, RecursionError):
        tree = None
    if not isinstance(tree, dict):
        raise FileError(f"{name}: is not as this version writes it")
    return tree


def _check_version(name: str, header: dict[str, str]) -> None:
    try:
        said = json.loads(header["ggwarp"])
        version, checksum = said["format"], said["sha256"]
    except (KeyError, TypeError, ValueError, RecursionError):
        raise FileError(f"{name}: is no checkpoint of ggwarp") from None
    if not isinstance(version, int) or not isinstance(checksum, str):
        raise FileError(f"{name}: is no checkpoint of ggwarp")
    if version != FORMAT:
        remedy = "newer than this ggwarp; update it" if version > FORMAT else "older; run the sequence again"
        raise FileError(f"{name}: has format {shown(version)}, which is {remedy}")


def _without_arrays(tree: Any, name: str, arrays: dict[str, NDArray[Any] | StoredArray]) -> Any:
    """Return ``tree`` as JSON has it; its arrays go to ``arrays``, and their names to their places."""
    if isinstance(tree, StoredArray):
        arrays[name] = tree
        return {_ARRAY: name}
    if isinstance(tree, np.ndarray):
        arrays[name] = np.ascontiguousarray(tree).reshape(tree.shape)
        return {_ARRAY: name}
    if isinstance(tree, dict):
        return {k: _without_arrays(v, f"{name}.{k}" if name else k, arrays) for k, v in tree.items()}
    if isinstance(tree, list):
        return [_without_arrays(v, f"{name}.{i}", arrays) for i, v in enumerate(tree)]
    return tree


def _with_arrays(tree: Any, arrays: dict[str, NDArray[Any]], depth: int = 0) -> Any:
    if depth > _DEEPEST:
        raise ValueError("nested too deeply")
    if isinstance(tree, list):
        return [_with_arrays(v, arrays, depth + 1) for v in tree]
    if not isinstance(tree, dict):
        return tree
    if tree.keys() == {_ARRAY}:
        return arrays[tree[_ARRAY]]
    return {k: _with_arrays(v, arrays, depth + 1) for k, v in tree.items()}


def _checksum(text: str, arrays: dict[str, NDArray[Any]]) -> str:
    digest = _begun(text)
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(_named(name, array))
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def _begun(text: str) -> Any:
    return hashlib.sha256(text.encode())


def _named(name: str, array: NDArray[Any] | StoredArray) -> bytes:
    return f"\n{name} {array.dtype.str} {array.shape}\n".encode()
