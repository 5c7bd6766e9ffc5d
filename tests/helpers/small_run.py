# SPDX-License-Identifier: Apache-2.0
"""A small run folder: a patterned wall, a red cube (5) and a green one (8); and exports read back."""

import json
import struct
from pathlib import Path

import numpy as np

from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import write_camera
from ggwarp.io.json import write_json
from ggwarp.io.ply import write_ply
from ggwarp.io.trajectory import write_tum
from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.objects.inventory import inventory

CAMERA = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)


def _grid(count: int, half: float) -> np.ndarray:
    at = np.linspace(-half, half, count)
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def _cube(centre: tuple[float, float, float], half: float) -> np.ndarray:
    faces = []
    for axis in range(3):
        for side in (-half, half):
            faces.append(np.insert(_grid(9, half), axis, side, axis=1))
    return np.concatenate(faces) + centre


def wall_and_cubes() -> Gaussians:
    """Return the map: wall 1, cubes 5 and 8."""
    wall = np.insert(_grid(50, 1.5), 2, 3.0, axis=1)
    red, green = _cube((-0.3, 0.0, 2.0), 0.2), _cube((0.5, 0.1, 2.2), 0.15)
    means = np.concatenate([wall, red, green]).astype(np.float32)
    ids = np.repeat([1, 5, 8], [len(wall), len(red), len(green)]).astype(np.int32)
    paint = {1: [0.5, 0.5, 0.6], 5: [0.9, 0.1, 0.1], 8: [0.1, 0.8, 0.2]}
    colours = np.array([paint[i] for i in ids.tolist()])
    n = len(means)
    return Gaussians(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.full((n, 3), np.log(0.03), np.float32),
        np.full(n, 3.0, np.float32),
        ((colours - 0.5) / SH_C0).astype(np.float32),
        ids,
        np.eye(16, dtype=np.float32)[ids],
    )


def write_small_run(folder: Path, scene: Gaussians) -> Path:
    """Write the run folder of ``scene``, seen by five cameras; return it."""
    folder.mkdir()
    names = {1: "wall", 5: "cube", 8: "cube"}
    records = inventory(scene.means, scene.colours, scene.object_ids, names=names)
    write_ply(folder / "map.ply", scene)
    write_json(folder / "objects.json", {"objects": [r.to_json() for r in records]})
    write_camera(folder / "camera.json", CAMERA)
    poses = [np.eye(4) for _ in range(5)]
    for i, T_wc in enumerate(poses):
        T_wc[0, 3] = 0.3 * (i - 2)
    poses[4][:3, :3] = np.diag([-1.0, 1.0, -1.0])  # looks away
    write_tum(folder / "trajectory.txt", np.arange(5), poses)
    (folder / "config.toml").write_text('seq = "x"\n')
    return folder


def decibels(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the PSNR of whole images [h, w, 3] in 0..1."""
    error = float(np.mean((image.astype(np.float64) - reference) ** 2))
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))


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
