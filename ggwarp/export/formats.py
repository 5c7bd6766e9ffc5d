# SPDX-License-Identifier: Apache-2.0
"""What a map can be exported to."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.results.saved_run import RunError

Writer = Callable[[ExportScene, Path, ExportOptions], None]


@dataclass(frozen=True)
class Format:
    """One kind of file.

    Attributes:
        about: what it is, and what opens it.
        ending: of the file's name; a folder has none.
        convention: its axes, see :data:`ggwarp.geometry.upright.CONVENTIONS`.
        writer: module and function.
        package: imported by the writer, and the extra that brings it; None: none is needed.
        has_objects: whether it tells objects apart.
        lossless: whether splats come back as they were.
    """

    about: str
    ending: str
    convention: str
    writer: tuple[str, str]
    package: tuple[str, str] | None = None
    has_objects: bool = False
    lossless: bool = False

    def check(self) -> None:
        """Raise RunError where what it needs is not installed."""
        if self.package is not None and importlib.util.find_spec(self.package[0]) is None:
            raise RunError(f"{self.package[0]} is not installed: pip install 'ggwarp[{self.package[1]}]'")

    def write(self, scene: ExportScene, path: Path, options: ExportOptions) -> None:
        """Write ``scene``.

        Raises:
            RunError: it cannot be done.
            OSError: the file cannot be written.
        """
        module, function = self.writer
        write: Writer = getattr(importlib.import_module(f"ggwarp.export.{module}"), function)
        write(scene, path, options)


_FORGE = ("gaussforge", "export")
_PACKED = ("splats", "write_packed")

FORMATS: dict[str, Format] = {
    "ply": Format(
        "splats: SuperSplat, gsplat, the reference viewer and most others",
        ".ply",
        "y-down",
        ("splats", "write_splat_ply"),
        has_objects=True,
        lossless=True,
    ),
    "compressed-ply": Format(
        "splats, a quarter of the size: SuperSplat, PlayCanvas", ".compressed.ply", "y-down", _PACKED, _FORGE
    ),
    "spz": Format("splats, a fifth of the size: Niantic, Cesium", ".spz", "y-up", _PACKED, _FORGE),
    "sog": Format("splats, a fifth of the size, for the web: PlayCanvas", ".sog", "y-down", _PACKED, _FORGE),
    "splat": Format("splats, half the size: antimatter15's viewer", ".splat", "y-down", _PACKED, _FORGE),
    "gltf": Format(
        "splats as KHR_gaussian_splatting: PlayCanvas, Cesium, Babylon.js; points elsewhere",
        ".splats.glb",
        "y-up",
        ("gltf", "write_splat_gltf"),
        has_objects=True,
        lossless=True,
    ),
    "usd": Format(
        "splats as ParticleField3DGaussianSplat: Omniverse, OpenUSD 26.03",
        ".usdc",
        "y-up",
        ("usd", "write_usd"),
        ("pxr", "export"),
        has_objects=True,
        lossless=True,
    ),
    "glb": Format(
        "a mesh, a node for each object: Blender, Unity, Unreal, Windows, three.js",
        ".glb",
        "y-up",
        ("gltf", "write_mesh_gltf"),
        has_objects=True,
    ),
    "mesh": Format(
        "a mesh as PLY, objects by face: MeshLab, CloudCompare, Open3D",
        ".mesh.ply",
        "z-up",
        ("mesh", "write_mesh_ply"),
        has_objects=True,
    ),
    "points": Format(
        "a cloud of points: CloudCompare, PCL, Open3D",
        ".points.ply",
        "z-up",
        ("points", "write_points"),
        has_objects=True,
    ),
    "colmap": Format(
        "frames with poses in COLMAP's text form, for training elsewhere",
        "",
        "y-down",
        ("recordings", "write_colmap"),
    ),
    "nerfstudio": Format(
        "frames with poses as transforms.json, with depth and points",
        "",
        "z-up",
        ("recordings", "write_nerfstudio"),
    ),
    "film": Format(
        "the map along the run's path, 20 seconds at most, as animated WebP: browsers, chats",
        ".webp",
        "y-down",
        ("film", "write_film"),
    ),
    "orbit": Format(
        "one turn about the map or about objects, from above, 8 seconds of animated WebP",
        ".orbit.webp",
        "y-down",
        ("film", "write_orbit"),
    ),
    "rrd": Format(
        "a recording for the rerun viewer: map, path, boxes, figures",
        ".rrd",
        "z-up",
        ("rerun_log", "write_rerun"),
        ("rerun", "rerun"),
        has_objects=True,
    ),
}
"""By the word after ``--to``."""
