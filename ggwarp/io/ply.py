# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps as PLY files in the 3DGS layout, which viewers know.

float32 ``x y z nx ny nz f_dc_0..2 f_rest_... opacity scale_0..2 rot_0..3`` (opacity a logit, scales
logarithms, rotations w first), then, where there are any, ``object_id`` and ``id_0..15``, which viewers
skip. Binary, little-endian. All are float32, also ids (as long as it holds them, up to 2^24): many readers
take every property for one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ggwarp.io.atomic import atomic_write
from ggwarp.io.guarded import MAP, open_file
from ggwarp.io.printable import printable, shortened
from ggwarp.map.gaussians import Gaussians
from ggwarp.types import Float32

IDENTITY_SIZE = 16

_GROUPS = {
    "means": ("x", "y", "z"),
    "colours": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity_logits": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_NORMAL = ("nx", "ny", "nz")
_IDENTITY = tuple(f"id_{i}" for i in range(IDENTITY_SIZE))
_NAMES = {"<f4": "float", "<i4": "int"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LIMIT = 1 << 20
_MOST_PROPERTIES = 1000
_LARGEST_EXACT = 1 << 24
"""Up to here float32 holds every whole number."""
_LARGEST_LOGIT = 100.0
_LARGEST = {
    "means": 1e6,
    "colours": 1e4,
    "opacity_logits": _LARGEST_LOGIT,
    "log_scales": _LARGEST_LOGIT,
    "quats": 1e6,
    "identities": 1e6,
    "object_ids": float(np.iinfo(np.int32).max),
}
"""Of the numbers of a Gaussian; metres, where they have a unit."""


class PlyError(ValueError):
    """A PLY file cannot be used: one line with the file, what is wrong and the remedy."""


def write_ply(path: str | Path, gaussians: Gaussians, *, sh_degree: int = 0) -> None:
    """Write ``gaussians``; nothing is left half-written.

    Rotations are normalised on the way: not every viewer does.

    Args:
        sh_degree: of the spherical harmonics in the file, 0 to 3; those above 0 are zeros, for readers that
            insist on them.

    Raises:
        OSError: the file cannot be written.
        ValueError: the arrays' shapes do not fit together.
    """
    write_ply_parts(path, lambda: [gaussians], sh_degree=sh_degree)


def write_ply_parts(path: str | Path, parts: Callable[[], Iterable[Gaussians]], *, sh_degree: int = 0) -> int:
    """Write the Gaussians of all ``parts``, one after another; return how many they are.

    Args:
        parts: gives them twice, from the first on: their number comes before them in the file.
        sh_degree: as of :func:`write_ply`.

    Raises:
        OSError: the file cannot be written.
        ValueError: the arrays' shapes do not fit together, or those of one part with another's.
    """
    count, types = 0, dict[str, str]()
    for part in parts():
        own = _property_types(part, sh_degree)
        if types and own.keys() != types.keys():
            raise ValueError("only some of the maps have object ids, or identities")
        count, types = count + len(part), {name: _wider(own[name], types.get(name)) for name in own}
    with atomic_write(path) as file:
        file.write(_header(count, types))
        for part in parts():
            file.write(_table(part, types).tobytes())
    return count


def ply_bytes(gaussians: Gaussians, *, sh_degree: int = 0) -> bytes:
    """Return the file that :func:`write_ply` writes.

    Raises:
        ValueError: the arrays' shapes do not fit together.
    """
    types = _property_types(gaussians, sh_degree)
    return _header(len(gaussians), types) + _table(gaussians, types).tobytes()


def _property_types(g: Gaussians, sh_degree: int) -> dict[str, str]:
    """Return the type of each property of a file of ``g``, in its order."""
    rest = tuple(f"f_rest_{i}" for i in range(3 * ((sh_degree + 1) ** 2 - 1)))
    names = [*_GROUPS["means"], *_NORMAL, *_GROUPS["colours"], *rest]
    names += [name for group in list(_GROUPS)[2:] for name in _GROUPS[group]]
    if g.object_ids is not None:
        names.append("object_id")
    if g.identities is not None:
        names += _IDENTITY
    types = dict.fromkeys(names, "<f4")
    if g.object_ids is not None and np.max(g.object_ids, initial=0) > _LARGEST_EXACT:
        types["object_id"] = "<i4"
    return types


def _wider(one: str, other: str | None) -> str:
    """Return the type that holds the ids of both."""
    return "<i4" if "<i4" in (one, other) else one


def _header(count: int, types: dict[str, str]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", "comment ggwarp", f"element vertex {count}"]
    lines += [f"property {_NAMES[kind]} {name}" for name, kind in types.items()] + ["end_header\n"]
    return "\n".join(lines).encode()


def _table(g: Gaussians, types: dict[str, str]) -> NDArray:
    """Return the rows of the file."""
    quats = np.asarray(g.quats, np.float64)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.divide(quats, length, out=np.tile([1.0, 0.0, 0.0, 0.0], (len(quats), 1)), where=length > 0.0)
    columns = {"means": g.means, "colours": g.colours, "opacity_logits": g.opacity_logits}
    columns |= {"log_scales": g.log_scales, "quats": unit}
    table = np.zeros(len(quats), np.dtype(list(types.items())))
    for group, values in columns.items():
        _fill(table, _GROUPS[group], values, group)
    if g.object_ids is not None:
        _fill(table, ("object_id",), g.object_ids, "object_ids")
    if g.identities is not None:
        _fill(table, _IDENTITY, g.identities, "identities")
    return table


def read_ply(path: str | Path) -> Gaussians:
    """Read Gaussians written by us or by any program that keeps the 3DGS layout.

    Higher spherical harmonics (``f_rest_*``), normals and unknown properties are ignored.

    Raises:
        FileError: the file cannot be read.
        PlyError: it is not a binary PLY, a property is missing, it is truncated, or a number is too large.
    """
    with open_file(path, MAP) as file:
        count, dtype = _read_header(file, path)
        missing = [name for group in _GROUPS.values() for name in group if name not in (dtype.names or ())]
        if missing:
            raise PlyError(
                f"{path}: has no {', '.join(missing)}; it is not a Gaussian map in the 3DGS layout"
            )
        need, have = count * dtype.itemsize, os.fstat(file.fileno()).st_size - file.tell()
        if have < need:
            raise PlyError(f"{path}: truncated: {count} Gaussians take {need} bytes, {have} are left")
        table = np.frombuffer(file.read(need), dtype, count)
    names = dtype.names or ()
    groups = {group: _gather(table, properties) for group, properties in _GROUPS.items()}
    if set(_IDENTITY) <= set(names):
        groups["identities"] = _gather(table, _IDENTITY)
    if "object_id" in names:
        groups["object_ids"] = table["object_id"][:, None]
    # Some programs write an opacity of 1 as an infinite logit, and a flat Gaussian's scale as log 0.
    groups["opacity_logits"] = np.clip(groups["opacity_logits"], -_LARGEST_LOGIT, _LARGEST_LOGIT)
    groups["log_scales"] = np.maximum(groups["log_scales"], -_LARGEST_LOGIT)
    for group, values in groups.items():
        wrong = np.count_nonzero(~(np.abs(values) <= _LARGEST[group]).all(axis=1))
        if wrong:
            raise PlyError(f"{path}: the {group} of {wrong} of its {count} Gaussians are beyond all bounds")
    return Gaussians(
        means=groups["means"],
        quats=groups["quats"],
        log_scales=groups["log_scales"],
        opacity_logits=groups["opacity_logits"][:, 0],
        colours=groups["colours"],
        object_ids=groups["object_ids"][:, 0].astype(np.int32) if "object_ids" in groups else None,
        identities=groups.get("identities"),
    )


def _fill(table: NDArray, names: tuple[str, ...], values: ArrayLike, group: str) -> None:
    values = np.asarray(values)
    if values.size != len(table) * len(names):
        raise ValueError(f"{group} has shape {values.shape}; {len(table)} Gaussians need {len(names)} each")
    for name, column in zip(names, values.reshape(len(table), len(names)).T, strict=True):
        table[name] = column


def _gather(table: NDArray, names: tuple[str, ...]) -> Float32:
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)


def _read_header(file: BinaryIO, path: str | Path) -> tuple[int, np.dtype]:
    """Return the number of vertices and their record; leaves ``file`` at the first one."""
    if file.readline(16).rstrip() != b"ply":
        raise PlyError(f"{path}: is not a PLY file")
    order, count, fields, element = "", -1, [], ""
    while file.tell() < _HEADER_LIMIT:
        words = file.readline(4096).decode("ascii", "replace").split()
        match words:
            case ["end_header"]:
                if not order or count < 0:
                    break
                return count, np.dtype(fields)
            case ["format", kind, _]:
                if kind not in _ORDER:
                    raise PlyError(
                        f"{path}: format {_said(kind)}; only binary files are read: export it as binary"
                    )
                order = _ORDER[kind]
            case ["element", element, number]:
                if element == "vertex" and number.isdigit():
                    count = int(number)
                elif count < 0:
                    raise PlyError(
                        f"{path}: element {_said(element)} comes before the vertices: not a Gaussian map"
                    )
            case ["property", kind, name] if element == "vertex":
                if kind not in _TYPES:
                    raise PlyError(f"{path}: property {_said(name)} has the unknown type {_said(kind)}")
                if name in dict(fields):
                    raise PlyError(f"{path}: property {_said(name)} occurs twice")
                if len(fields) == _MOST_PROPERTIES:
                    raise PlyError(f"{path}: has more than {_MOST_PROPERTIES} properties: not a Gaussian map")
                fields.append((name, order + _TYPES[kind]))
            case ["property", "list", *_] if element == "vertex":
                raise PlyError(f"{path}: its vertices hold lists: not a Gaussian map")
            case ["property" | "comment" | "obj_info", *_]:
                pass
            case _:
                break
    raise PlyError(f"{path}: its PLY header is malformed or cut short")


def _said(word: str) -> str:
    """Return a word of the header as a message shows it."""
    return shortened(printable(word))
