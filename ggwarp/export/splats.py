# SPDX-License-Identifier: Apache-2.0
"""Splats as viewers of them read: the 3DGS PLY, and what GaussForge makes of it."""

from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path

from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.io.atomic import atomic_write
from ggwarp.io.ply import ply_bytes, write_ply
from ggwarp.results.saved_run import RunError


def write_splat_ply(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write the 3DGS layout and ``object_id``; identities stay in the run."""
    gaussians = dataclasses.replace(scene.gaussians, identities=None)
    write_ply(path, gaussians, sh_degree=options.sh_degree)


def write_packed(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write a packed form, by the ending of ``path``: spz, sog, splat, ksplat, compressed.ply.

    None of them can hold object ids.

    Raises:
        RunError: GaussForge refuses.
    """
    plain = dataclasses.replace(scene.gaussians, identities=None, object_ids=None)
    kind = "compressed.ply" if path.name.endswith(".compressed.ply") else path.suffix[1:]
    forge = importlib.import_module("gaussforge").GaussForge()
    packed = forge.convert(ply_bytes(plain, sh_degree=options.sh_degree), "ply", kind)
    if "error" in packed:
        raise RunError(f"{path}: GaussForge could not write it: {packed['error']}")
    with atomic_write(path) as file:
        file.write(packed["data"])
