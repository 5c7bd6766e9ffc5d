# SPDX-License-Identifier: Apache-2.0
"""The map's surface as triangles: rendered depth, fused into a volume (TSDF), and marching cubes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from ggwarp.editing.device import ready_device
from ggwarp.editing.map_view import MapView
from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.export.tsdf import Ints, Mesh, TsdfVolume
from ggwarp.io.atomic import atomic_write
from ggwarp.map.gaussians import Gaussians
from ggwarp.results.saved_run import RunError

_OPAQUE = 0.5  # accumulated opacity from which a pixel shows a surface
_MOST_VIEWS = 300
_LEAST_PART = 100  # triangles; smaller parts float in the air
_NEIGHBOURS = 3  # whose object a vertex has


def fused_mesh(scene: ExportScene, options: ExportOptions) -> Mesh:
    """Return the surface of the scene's Gaussians, in the scene's axes.

    Raises:
        RunError: the map shows no surface, or the device is none.
    """
    device = ready_device(options.device)
    poses = scene.poses[:: max(options.every, -(-len(scene.poses) // _MOST_VIEWS))]
    volume = TsdfVolume(scene.gaussians.means, voxel=options.voxel, device=device)
    view = MapView(scene.gaussians, scene.run.camera, device=device)
    for T_wc in poses:
        seen = view.render(T_wc)
        # Where a pixel mixes near and far, the mean depth lies on neither.
        depth, slack = seen.surface_depth, volume.truncation
        sure = (seen.opacity > _OPAQUE) & (np.abs(depth - seen.median_depth) < slack)
        colours = np.divide(seen.rgb, seen.opacity[..., None], out=seen.rgb.copy(), where=sure[..., None])
        volume.add(np.where(sure, depth, np.float32(0.0)), colours, T_wc, scene.run.camera)
    mesh = _without_crumbs(volume.surface())
    if not len(mesh.faces):
        raise RunError(f"{scene.run.folder}: its pictures show no surface of it; try a smaller --voxel")
    return dataclasses.replace(mesh, object_ids=_objects_of(mesh, scene.gaussians))


def write_mesh_ply(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write the surface as PLY: coloured vertices with normals, and ``object_id`` of each face."""
    mesh = fused_mesh(scene, options)
    vertices = np.zeros(len(mesh.vertices), [("at", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
    vertices["at"], vertices["normal"] = mesh.vertices, mesh.normals
    vertices["colour"] = np.rint(255.0 * mesh.colours)
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("rows", "<i4", 3), ("object_id", "<i4")])
    faces["count"], faces["rows"], faces["object_id"] = 3, mesh.faces, mesh.object_ids
    header = ["ply", "format binary_little_endian 1.0", "comment ggwarp", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += ["property int object_id", "end_header\n"]
    with atomic_write(path) as file:
        file.write("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def _without_crumbs(mesh: Mesh) -> Mesh:
    """Return ``mesh`` without parts of a few triangles."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(mesh.faces):
        return mesh
    count, (a, b, c) = len(mesh.vertices), mesh.faces.T
    rows, columns = np.concatenate([a, b]), np.concatenate([b, c])
    edges = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(count, count))
    part = connected_components(edges, directed=False)[1][a]
    sizes = np.bincount(part)
    return mesh.only(sizes[part] >= min(_LEAST_PART, sizes.max()))


def _objects_of(mesh: Mesh, gaussians: Gaussians) -> Ints:
    """Return [m] the object of each face: that of most of the Gaussians nearest to its corners."""
    from scipy.spatial import KDTree

    if gaussians.object_ids is None:
        return mesh.object_ids
    opaque = gaussians.opacity_logits > 0.0
    if opaque.sum() < _NEIGHBOURS:
        opaque[:] = True
    ids, numbers = np.unique(gaussians.object_ids[opaque], return_inverse=True)
    near = KDTree(gaussians.means[opaque]).query(mesh.vertices, k=_NEIGHBOURS)[1]
    near = np.minimum(near, len(numbers) - 1)  # fewer Gaussians than asked for
    votes = numbers[near][mesh.faces].reshape(len(mesh.faces), -1)
    ordered = np.sort(votes, axis=1)
    # The longest run of equal votes.
    same = (ordered[:, :, None] == ordered[:, None, :]).sum(axis=2)
    return ids[ordered[np.arange(len(ordered)), same.argmax(axis=1)]].astype(np.int32)
