# SPDX-License-Identifier: Apache-2.0
"""A rerun recording: the map's points, the camera's path, objects' boxes, and what was measured."""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.export.options import ExportOptions
from ggwarp.export.points import colours_of, visible_points
from ggwarp.export.scene import ExportScene
from ggwarp.geometry import se3
from ggwarp.results.frame_table import read_frames

_PLOTTED = ("tracking_ms", "mapping_ms", "overlap", "gaussians", "loss", "ate_cm", "psnr")


def write_rerun(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write the recording; timelines: ``frame``, the row of the trajectory."""
    rr: Any = importlib.import_module("rerun")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    recording = rr.RecordingStream("ggwarp", recording_id=scene.run.folder.name)
    try:
        recording.save(str(part))
        _log(rr, recording, scene)
        recording.flush()
        recording.disconnect()
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _log(rr: Any, recording: Any, scene: ExportScene) -> None:
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    points = visible_points(scene.gaussians)
    radii = np.exp(points.log_scales.mean(axis=1))
    colours = np.rint(255.0 * colours_of(points)).astype(np.uint8)
    ids = points.object_ids
    cloud = rr.Points3D(points.means, colors=colours, radii=radii, class_ids=ids if ids is not None else None)
    names = [(record.id, record.name, record.colour) for record in scene.objects if record.id < 1 << 16]
    recording.log("world", rr.AnnotationContext(names), static=True)
    recording.log("world/map", cloud, static=True)
    for record in scene.objects:
        box = record.oriented_box
        (quat,) = se3.rotate_quats(scene.R, np.array([box.quat]))
        recording.log(
            f"world/objects/{record.id}",
            rr.Boxes3D(
                centers=[scene.R @ np.array(box.centre)],
                half_sizes=[box.half_sizes],
                quaternions=[rr.Quaternion(xyzw=np.roll(quat, -1))],
                labels=[record.name],
                colors=[record.colour],
            ),
            static=True,
        )
    path = scene.poses[:, :3, 3]
    recording.log("world/path", rr.LineStrips3D([path]), static=True)
    camera = scene.run.camera
    pinhole = rr.Pinhole(
        image_from_camera=camera.matrix,
        width=camera.width,
        height=camera.height,
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    recording.log("world/camera", pinhole, static=True)
    table = read_frames(scene.run.folder).tracked()
    plotted = {name: table.numbers(name) for name in _PLOTTED}
    for number, T_wc in enumerate(scene.poses):
        recording.set_time("frame", sequence=number)
        recording.log("world/camera", rr.Transform3D(translation=T_wc[:3, 3], mat3x3=T_wc[:3, :3]))
        for name, values in plotted.items():
            if number < len(values) and math.isfinite(values[number]):
                recording.log(f"plots/{name}", rr.Scalars([values[number]]))
