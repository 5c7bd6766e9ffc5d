# SPDX-License-Identifier: Apache-2.0
"""The run as a recording with known poses, for other programs to train on: COLMAP and nerfstudio."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.config.presets import load_config
from ggwarp.config.run_config import ConfigError
from ggwarp.datasets import BadFrame, DatasetError, FrameReader, open_dataset
from ggwarp.editing.device import ready_device
from ggwarp.editing.map_view import MapView
from ggwarp.export.options import ExportOptions
from ggwarp.export.points import colours_of, visible_points, write_points
from ggwarp.export.scene import ExportScene
from ggwarp.geometry import se3
from ggwarp.io.atomic import atomic_write
from ggwarp.io.json import write_json
from ggwarp.results.frame_table import read_frames
from ggwarp.results.renders import depth_to_millimetres
from ggwarp.results.saved_run import RunError
from ggwarp.types import Float64

_MOST_POINTS = 200_000
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera (y up, z backwards) to ours."""


@dataclass(frozen=True)
class _Picture:
    """A frame as it is written.

    Attributes:
        name: of its file.
        rgb: [h, w, 3] uint8. depth: [h, w] uint16 millimetres; None: not known.
        T_wc: [4, 4] camera-to-world.
    """

    name: str
    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None
    T_wc: Float64


def write_colmap(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write ``images/``, ``depth/`` and ``sparse/0/{cameras,images,points3D}.txt``."""

    def work(folder: Path) -> None:
        sparse = folder / "sparse" / "0"
        sparse.mkdir(parents=True)
        c = scene.run.camera
        camera = f"1 PINHOLE {c.width} {c.height} {c.fx:.9g} {c.fy:.9g} {c.cx + 0.5:.9g} {c.cy + 0.5:.9g}\n"
        (sparse / "cameras.txt").write_text(camera)
        lines = []
        for number, picture in enumerate(_written(scene, folder, options), 1):
            T_cw = se3.inverse(picture.T_wc)
            values = [*se3.quat_from_matrix(T_cw[:3, :3]), *T_cw[:3, 3]]
            lines.append(f"{number} {' '.join(f'{v:.9g}' for v in values)} 1 {picture.name}\n\n")
        (sparse / "images.txt").write_text("".join(lines))
        points = visible_points(scene.gaussians)
        points = points.take(np.arange(0, len(points), -(-len(points) // _MOST_POINTS)))
        bytes_ = np.rint(255.0 * colours_of(points)).astype(int).tolist()
        rows = zip(points.means.tolist(), bytes_, strict=True)
        (sparse / "points3D.txt").write_text(
            "".join(
                f"{i} {x:.6g} {y:.6g} {z:.6g} {r} {g} {b} 0\n"
                for i, ((x, y, z), (r, g, b)) in enumerate(rows, 1)
            )
        )

    _write_folder(path, work)


def write_nerfstudio(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write ``images/``, ``depth/``, ``points.ply`` and ``transforms.json``."""

    def work(folder: Path) -> None:
        frames = []
        for picture in _written(scene, folder, options):
            frame: dict[str, Any] = {"file_path": f"images/{picture.name}"}
            if picture.depth is not None:
                frame["depth_file_path"] = f"depth/{picture.name}"
            frames.append(frame | {"transform_matrix": (picture.T_wc @ _OPENGL).tolist()})
        c = scene.run.camera
        write_points(scene, folder / "points.ply", options)
        values = {
            "camera_model": "OPENCV",
            "w": c.width,
            "h": c.height,
            "fl_x": c.fx,
            "fl_y": c.fy,
            "cx": c.cx + 0.5,
            "cy": c.cy + 0.5,
            "ply_file_path": "points.ply",
            "frames": frames,
        }
        write_json(folder / "transforms.json", values)

    _write_folder(path, work)


def _write_folder(path: Path, work: Callable[[Path], None]) -> None:
    """Have ``work`` fill a folder, which is then named ``path``; one that fails leaves nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        part.chmod(0o755)
        work(part)
        os.rename(part, path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _written(scene: ExportScene, folder: Path, options: ExportOptions) -> Iterator[_Picture]:
    """Yield the run's frames, having written their pictures."""
    (folder / "images").mkdir()
    pictures = _rendered(scene, options) if options.rendered else _recorded(scene, options)
    for picture in pictures:
        _save(folder / "images" / picture.name, picture.rgb[..., ::-1])
        if picture.depth is not None:
            (folder / "depth").mkdir(exist_ok=True)
            _save(folder / "depth" / picture.name, picture.depth)
        yield picture


def _rendered(scene: ExportScene, options: ExportOptions) -> Iterator[_Picture]:
    view = MapView(scene.gaussians, scene.run.camera, device=ready_device(options.device))
    for number in range(0, len(scene.poses), options.every):
        seen = view.render(scene.poses[number])
        rgb = np.rint(255.0 * seen.rgb).astype(np.uint8)
        name, depth = f"frame{number:06d}.png", depth_to_millimetres(seen.surface_depth)
        yield _Picture(name, rgb, depth, scene.poses[number])


def _recorded(scene: ExportScene, options: ExportOptions) -> Iterator[_Picture]:
    """Yield the recording's own frames at the run's poses."""
    folder = scene.run.folder
    remedy = "--rendered has the map's pictures instead"
    if not scene.whole:
        raise RunError(f"objects alone are in no picture of the recording; {remedy}")
    indices = read_frames(folder).tracked().indices()[:: options.every]
    poses = dict(zip(indices, scene.poses[:: options.every], strict=False))
    if not (folder / "config.toml").is_file() or len(poses) != len(scene.poses[:: options.every]):
        raise RunError(f"{folder}: does not say which frames of which recording it is of; {remedy}")
    try:
        config = load_config(folder / "config.toml")
        dataset = open_dataset(
            config.seq or "",
            data_root=config.data_root(),
            masks="none",
            faults=config.built_in,
            intrinsics=config.intrinsics,
        )
        reader = FrameReader(dataset, indices, scale=config.scale or 1.0)
        with reader:
            for frame in reader:
                if isinstance(frame, BadFrame):
                    raise RunError(f"{frame.reason}; {remedy}")
                depth = None if frame.depth is None else depth_to_millimetres(frame.depth)
                yield _Picture(f"frame{frame.index:06d}.png", frame.rgb, depth, poses[frame.index])
    except (ConfigError, DatasetError) as error:
        raise RunError(f"the recording cannot be read: {error}; {remedy}") from None


def _save(path: Path, picture: NDArray[Any]) -> None:
    with atomic_write(path) as file:
        file.write(cv2.imencode(".png", picture)[1].tobytes())
