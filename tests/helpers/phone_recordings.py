# SPDX-License-Identifier: Apache-2.0
"""Writers of small recordings of phones' apps, of the room in ``recorded_scene``."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import cv2
import lzfse
import numpy as np
import OpenEXR

from ggwarp.datasets import Dataset, open_dataset
from recorded_scene import COLOUR, gl, jpeg, look, millimetres, png, pose, quaternion

SMALL = COLOUR.resized(40, 30)
FRAMES = 3
K_ROWS = [[COLOUR.fx, 0.0, COLOUR.cx], [0.0, COLOUR.fy, COLOUR.cy], [0.0, 0.0, 1.0]]


def write(path: Path, data: bytes | str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def opened(path: Path) -> Dataset:
    return open_dataset(str(path), data_root=path.parent / "nowhere")


def stray(path: Path, *, own_cameras: bool = False) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    size = (COLOUR.width, COLOUR.height)
    video = cv2.VideoWriter(str(path / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 60, size)
    assert video.isOpened()
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + ", fx, fy, cx, cy" * own_cameras]
    for i in range(FRAMES):
        rgb, _ = look(COLOUR, pose(i))
        video.write(rgb[..., ::-1])
        depth = look(SMALL, pose(i))[1]
        write(path / f"depth/{i:06d}.png", png(millimetres(depth)))
        sure = np.full(depth.shape, 2, np.uint8)
        sure[:4], sure[4:12] = 0, 1
        write(path / f"confidence/{i:06d}.png", png(sure))
        values = [i / 60, i, *pose(i)[:3, 3], *quaternion(pose(i))]
        values += [COLOUR.fx, COLOUR.fy, COLOUR.cx, COLOUR.cy] if own_cameras else []
        rows.append(", ".join(f"{i:06d}" if k == 1 else f"{v}" for k, v in enumerate(values)))
    video.release()
    write(path / "odometry.csv", "\n".join(rows))
    write(path / "camera_matrix.csv", "\n".join(", ".join(map(str, row)) for row in K_ROWS))
    return path


def metadata(**more: object) -> str:
    values = {
        "K": np.array(K_ROWS).T.ravel().tolist(),
        "w": COLOUR.width,
        "h": COLOUR.height,
        "fps": 60,
        "poses": [[*quaternion(gl(pose(i))), *pose(i)[:3, 3].tolist()] for i in range(FRAMES)],
    }
    return json.dumps(values | more)


def r3d(path: Path, **more: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = COLOUR.resized(256, 192)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", metadata(**more))
        for i in range(FRAMES):
            archive.writestr(f"rgbd/{i}.jpg", jpeg(look(COLOUR, pose(i))[0]))
            depth = look(camera, pose(i))[1]
            depth[0, 0] = np.nan
            sure = np.full(depth.shape, 2, np.uint8)
            sure[-40:] = 0
            archive.writestr(f"rgbd/{i}.depth", lzfse.compress(depth.tobytes()))
            archive.writestr(f"rgbd/{i}.conf", lzfse.compress(sure.tobytes()))
    return path


def record3d_export(path: Path) -> None:
    write(path / "metadata.json", metadata(frameTimestamps=[0, 0.5, 0.7]))
    (path / "depth").mkdir()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for i in range(FRAMES):
        write(path / f"rgb/{i}.jpg", jpeg(look(COLOUR, pose(i))[0]))
        depth = look(SMALL, pose(i))[1].astype(np.float16)
        OpenEXR.File(header, {"R": depth}).write(str(path / f"depth/{i}.exr"))


def polycam(path: Path) -> None:
    for i in range(FRAMES):
        stamp = 1_000_000 + 33_000 * i
        rgb, _ = look(COLOUR, pose(i))
        write(path / f"keyframes/corrected_images/{stamp}.jpg", jpeg(rgb))
        write(path / f"keyframes/images/{stamp}.jpg", jpeg(255 - rgb))
        write(path / f"keyframes/depth/{stamp}.png", png(millimetres(look(SMALL, pose(i))[1])))
        write(
            path / f"keyframes/confidence/{stamp}.png",
            png(np.full((SMALL.height, SMALL.width), 127, np.uint8)),
        )
        values = {f"t_{r}{c}": float(gl(pose(i))[r, c]) for r in range(3) for c in range(4)}
        values |= {
            "width": 80,
            "height": 60,
            "fx": COLOUR.fx,
            "fy": COLOUR.fy,
            "cx": COLOUR.cx,
            "cy": COLOUR.cy,
        }
        for kind in ("cameras", "corrected_cameras"):
            write(path / f"keyframes/{kind}/{stamp}.json", json.dumps(values))


def scanner_app(path: Path) -> None:
    for i in range(2 * FRAMES):
        at = pose(i // 2)
        write(path / f"depth_{i:05d}.png", png(millimetres(look(SMALL, at)[1])))
        write(path / f"conf_{i:05d}.png", png(np.full((SMALL.height, SMALL.width), 2, np.uint8)))
        values = {
            "intrinsics": np.ravel(K_ROWS).tolist(),
            "cameraPoseARFrame": gl(at).ravel().tolist(),
            "time": i / 60,
        }
        write(path / f"frame_{i:05d}.json", json.dumps(values))
        if i % 2 == 0:
            write(path / f"frame_{i:05d}.jpg", jpeg(look(COLOUR, at)[0]))
