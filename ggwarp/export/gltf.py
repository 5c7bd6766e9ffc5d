# SPDX-License-Identifier: Apache-2.0
"""Binary glTF 2.0: meshes, and splats by KHR_gaussian_splatting."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ggwarp
from ggwarp.export.mesh import Mesh, fused_mesh
from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.io.atomic import atomic_write
from ggwarp.map.gaussians import SH_C0
from ggwarp.types import Float32

_POINTS, _TRIANGLES = 0, 4
_ARRAY, _ELEMENTS = 34962, 34963
_COMPONENTS = {"uint8": 5121, "uint32": 5125, "float32": 5126}
_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_EXTENSION = "KHR_gaussian_splatting"


class _Document:
    """A glTF document with one binary buffer."""

    def __init__(self) -> None:
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []
        self._nodes: list[dict[str, Any]] = []
        self._parts: list[bytes] = []
        self._size = 0

    def array(self, values: NDArray[Any], *, target: int = _ARRAY, bounds: bool = False) -> int:
        """Add ``values`` [n] or [n, k]; return the number of their accessor."""
        values = np.ascontiguousarray(values)
        width = 1 if values.ndim == 1 else values.shape[1]
        data = values.tobytes()
        data += bytes(-len(data) % 4)
        self._views.append(
            {"buffer": 0, "byteOffset": self._size, "byteLength": values.nbytes, "target": target}
        )
        accessor: dict[str, Any] = {
            "bufferView": len(self._views) - 1,
            "componentType": _COMPONENTS[values.dtype.name],
            "count": len(values),
            "type": _SHAPES[width],
        }
        if values.dtype == np.uint8:
            accessor["normalized"] = True
        if bounds:
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self._parts.append(data)
        self._size += len(data)
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def node(self, name: str, primitive: dict[str, Any], **extras: Any) -> None:
        """Add a node with a mesh of one ``primitive``."""
        self._meshes.append({"name": name, "primitives": [primitive]})
        node: dict[str, Any] = {"name": name, "mesh": len(self._meshes) - 1}
        self._nodes.append(node | ({"extras": extras} if extras else {}))

    def write(self, path: Path, **members: Any) -> None:
        """Write the document, with further ``members`` at its top."""
        document = {
            "asset": {"version": "2.0", "generator": f"ggwarp {ggwarp.__version__}"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(self._nodes)))}],
            "nodes": self._nodes,
            "meshes": self._meshes,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
            **members,
        }
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        binary = b"".join(self._parts)
        with atomic_write(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary)))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)


def write_splat_gltf(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write splats as Khronos' extension has them; a program without it shows coloured points."""
    g = scene.gaussians
    opacity = (1.0 / (1.0 + np.exp(-g.opacity_logits.astype(np.float64)))).astype(np.float32)
    document = _Document()
    fallback = np.concatenate([_linear(0.5 + SH_C0 * g.colours), opacity[:, None]], axis=1)
    attributes = {
        "POSITION": document.array(g.means, bounds=True),
        "COLOR_0": document.array(_bytes(fallback)),
        f"{_EXTENSION}:ROTATION": document.array(np.roll(g.quats, -1, axis=1)),  # w last
        f"{_EXTENSION}:SCALE": document.array(np.exp(g.log_scales)),
        f"{_EXTENSION}:OPACITY": document.array(opacity),
        f"{_EXTENSION}:SH_DEGREE_0_COEF_0": document.array(g.colours),
    }
    if g.object_ids is not None:
        attributes["_OBJECT_ID"] = document.array(g.object_ids.astype(np.float32))
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": _POINTS, "attributes": attributes, "extensions": {_EXTENSION: extension}}
    document.node(scene.run.folder.name, primitive)
    document.write(path, extensionsUsed=[_EXTENSION])


def write_mesh_gltf(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write the surface, a node for each object, named as it is."""
    document = _Document()
    for identifier, part in fused_mesh(scene, options).by_object():
        document.node(scene.name_of(identifier), _triangles(document, part), object_id=identifier)
    # The colours are light already, not paint that light falls on.
    material = {
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    }
    document.write(path, materials=[material], extensionsUsed=["KHR_materials_unlit"])


def _triangles(document: _Document, mesh: Mesh) -> dict[str, Any]:
    attributes = {
        "POSITION": document.array(mesh.vertices, bounds=True),
        "NORMAL": document.array(mesh.normals),
        "COLOR_0": document.array(_bytes(np.insert(_linear(mesh.colours), 3, 1.0, axis=1))),
    }
    indices = document.array(mesh.faces.astype(np.uint32).ravel(), target=_ELEMENTS)
    return {"mode": _TRIANGLES, "attributes": attributes, "indices": indices, "material": 0}


def _linear(srgb: Float32) -> Float32:
    """Return the linear light of ``srgb``, 0..1, which glTF wants of colours at vertices."""
    srgb = np.clip(srgb, 0.0, 1.0)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _bytes(colours: Float32) -> NDArray[np.uint8]:
    return np.rint(255.0 * colours).astype(np.uint8)
