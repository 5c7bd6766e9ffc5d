# SPDX-License-Identifier: Apache-2.0
"""The Gaussians' centres as a cloud of coloured points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.io.atomic import atomic_write
from ggwarp.map.gaussians import SH_C0, Gaussians
from ggwarp.types import Float32


def visible_points(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians that are more opaque than not; all, where none is."""
    opaque = gaussians.opacity_logits > 0.0
    return gaussians.take(opaque) if opaque.any() else gaussians


def colours_of(gaussians: Gaussians) -> Float32:
    """Return [n, 3] red, green, blue, 0..1."""
    return np.clip(0.5 + SH_C0 * gaussians.colours, 0.0, 1.0)


def write_points(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write a PLY of points: position, colour, ``object_id``."""
    points = visible_points(scene.gaussians)
    ids = points.object_ids if points.object_ids is not None else np.zeros(len(points), np.int32)
    table = np.zeros(len(points), [("at", "<f4", 3), ("colour", "u1", 3), ("object_id", "<i4")])
    table["at"], table["object_id"] = points.means, ids
    table["colour"] = np.rint(255.0 * colours_of(points))
    header = ["ply", "format binary_little_endian 1.0", "comment ggwarp", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in ("x", "y", "z")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += ["property int object_id", "end_header\n"]
    with atomic_write(path) as file:
        file.write("\n".join(header).encode() + table.tobytes())
