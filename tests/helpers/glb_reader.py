# SPDX-License-Identifier: Apache-2.0
"""Binary glTF read back, by its specification."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np


def read_glb(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    rest, bin_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (kind, bin_kind) == (b"JSON", b"BIN\0") and size % 4 == rest % 4 == 0
    return json.loads(data[20 : 20 + size]), data[28 + size : 28 + size + rest]


def read_accessor(document: dict, binary: bytes, number: int) -> np.ndarray:
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    kind = {5121: "u1", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    array = np.frombuffer(binary, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
    if "min" in accessor:
        assert np.array_equal(accessor["min"], array.min(0)) and np.array_equal(accessor["max"], array.max(0))
    return array
