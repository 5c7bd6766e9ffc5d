# SPDX-License-Identifier: Apache-2.0
"""Writers of small data sets as they are distributed, of the room in ``recorded_scene``."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import lz4.block
import numpy as np
import OpenEXR

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from phone_recordings import FRAMES, K_ROWS, polycam, record3d_export, scanner_app, stray, write
from recorded_scene import COLOUR, gl, jpeg, look, millimetres, png, pose, quaternion

DEPTH_CAMERA = Camera(64, 48, 55.0, 55.5, 31.0, 24.2)
COLOUR_FROM_DEPTH = se3.se3_exp([0.03, 0.0, 0.0, 0.0, 0.01, 0.0])


def table(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.9g}" for value in row) for row in matrix)


def four(camera: Camera) -> np.ndarray:
    """Return intrinsics as ScanNet has them, 4x4."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.matrix
    return matrix


def arkitscenes(path: Path) -> None:
    rows = []
    for i in range(FRAMES):
        name = f"41069021_{305.377 + 0.1 * i:.3f}"
        rgb, depth = look(COLOUR, pose(i))
        write(path / f"lowres_wide/{name}.png", png(rgb))
        write(path / f"lowres_depth/{name}.png", png(millimetres(depth)))
        write(path / f"confidence/{name}.png", png(np.full(depth.shape, 1, np.uint8)))
        near = f"41069021_{305.378 + 0.1 * i:.3f}" if i == 1 else name
        camera = f"80 60 {COLOUR.fx} {COLOUR.fy} {COLOUR.cx} {COLOUR.cy}"
        write(path / f"lowres_wide_intrinsics/{near}.pincam", camera)
        T_cw = se3.inverse(pose(i))
        turn = cv2.Rodrigues(T_cw[:3, :3])[0].ravel()
        rows.append(" ".join(map(str, [305.377 + 0.1 * i, *turn, *T_cw[:3, 3]])))
    write(path / "lowres_wide.traj", "\n".join(rows))


def scannet(path: Path) -> None:
    for i in range(FRAMES):
        write(path / f"color/{i}.jpg", jpeg(look(COLOUR, pose(i))[0]))
        write(path / f"depth/{i}.png", png(millimetres(look(DEPTH_CAMERA, pose(i))[1])))
        write(path / f"pose/{i}.txt", table(pose(i)))
    for name, camera in (("color", COLOUR), ("depth", DEPTH_CAMERA)):
        write(path / f"intrinsic/intrinsic_{name}.txt", table(four(camera)))
        write(path / f"intrinsic/extrinsic_{name}.txt", table(np.eye(4)))


def sens(path: Path, *, packing: int = 1) -> Path:
    moved = COLOUR_FROM_DEPTH
    data = struct.pack("<IQ", 4, 6) + b"camera"
    for matrix in (four(COLOUR), np.eye(4), four(DEPTH_CAMERA), moved):
        data += struct.pack("<16f", *matrix.ravel())
    data += struct.pack("<iiIIIIfQ", 2, packing, 80, 60, 64, 48, 1000.0, FRAMES)
    for i in range(FRAMES):
        rgb, _ = look(COLOUR, pose(i))
        depth = millimetres(look(DEPTH_CAMERA, pose(i) @ moved)[1])
        depth[0, 0] = 65535
        raw = depth.astype("<u2").tobytes()
        parts = jpeg(rgb), zlib.compress(raw) if packing else raw
        data += struct.pack("<16f4Q", *pose(i).ravel(), 33_000 * i + 7, 0, *map(len, parts)) + b"".join(parts)
    return write(path, data)


def scannetpp(path: Path, form: str) -> None:
    path.mkdir(parents=True, exist_ok=True)
    values = {}
    video = cv2.VideoWriter(str(path / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 60, (80, 60))
    pictures = []
    for i in range(FRAMES):
        video.write(look(COLOUR, pose(i))[0][..., ::-1])
        pictures.append(look(COLOUR.resized(256, 192), pose(i))[1])
        values[f"frame_{i:06d}"] = {
            "timestamp": i / 60,
            "aligned_pose": pose(i).tolist(),
            "intrinsic": K_ROWS,
        }
    video.release()
    write(path / "pose_intrinsic_imu.json", json.dumps(values))
    if form == "stream":
        data = _deflate(np.stack(pictures).astype("<f4").tobytes())
    else:
        frames = [
            lz4.block.compress(millimetres(p).tobytes(), store_size=False)
            if form == "lz4"
            else _deflate(p.astype("<f4").tobytes())
            for p in pictures
        ]
        data = b"".join(struct.pack("<I", len(frame)) + frame for frame in frames)
    write(path / "depth.bin", data)


def _deflate(data: bytes) -> bytes:
    packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


def seven_scenes(path: Path) -> None:
    """Write a Kinect's pictures as 7-Scenes has them: depth as seen from its own place, not registered."""
    depth_camera = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
    colour_camera = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
    moved = np.eye(4)
    moved[:3, :3] = se3.so3_exp([0.00816, -0.00789, -0.00271])
    moved[:3, 3] = -0.02555894, 0.00010110, 0.00203183
    for i in range(FRAMES):
        raw = millimetres(look(depth_camera, pose(i) @ moved)[1])
        raw[:2] = 65535
        write(path / f"frame-{i:06d}.color.png", png(look(colour_camera, pose(i))[0]))
        write(path / f"frame-{i:06d}.depth.png", png(raw))
        write(path / f"frame-{i:06d}.pose.txt", table(pose(i)))


def bundle_fusion(path: Path, *, info: bool = True) -> None:
    for i in range(FRAMES):
        rgb, depth = look(COLOUR, pose(i))
        raw = millimetres(depth)
        raw[:4] = 65535
        write(path / f"frame-{i:06d}.color.jpg", jpeg(rgb))
        write(path / f"frame-{i:06d}.depth.png", png(raw))
        write(path / f"frame-{i:06d}.pose.txt", table(pose(i)))
    if info:
        lines = [
            f"m_calibration{n}Intrinsic = {' '.join(map(str, four(COLOUR).ravel()))}"
            for n in ("Color", "Depth")
        ]
        write(
            path / "info.txt",
            "m_depthWidth = 80\nm_depthHeight = 60\nm_depthShift = 1000\n" + "\n".join(lines),
        )


def nerfstudio(path: Path, *, capture: bool = False) -> None:
    frames = []
    for i in range(FRAMES):
        rgb, depth = look(COLOUR, pose(i))
        write(path / f"images/{i}.png", png(rgb))
        scale = 65535 / 10 if capture else 1000
        write(path / f"images/{i}.depth.png", png(np.rint(depth * scale).astype(np.uint16)))
        frame = {"transform_matrix": gl(pose(i)).tolist()}
        if capture:
            frame |= {"file_path": f"images/{i}", "depth_path": f"images/{i}.depth.png", "timestamp": 5.0 + i}
        else:
            frame |= {"file_path": f"images/{i}.png", "depth_file_path": f"images/{i}.depth.png"}
        frames.append(frame)
    values = {
        "w": 80,
        "h": 60,
        "fl_x": COLOUR.fx,
        "fl_y": COLOUR.fy,
        "cx": COLOUR.cx + 0.5,
        "cy": COLOUR.cy + 0.5,
    }
    values |= {"integer_depth_scale": 10 / 65535} if capture else {"camera_model": "OPENCV", "k1": 0.0}
    write(path / "transforms.json", json.dumps(values | {"frames": frames[::-1]}))


def colmap(path: Path, *, binary: bool) -> None:
    p = [COLOUR.fx, COLOUR.fy, COLOUR.cx + 0.5, COLOUR.cy + 0.5]
    records, lines = b"", []
    for i in range(FRAMES):
        rgb, depth = look(COLOUR, pose(i))
        write(path / f"images/walk/{i}.png", png(rgb))
        write(path / f"depth/walk/{i}.png", png(millimetres(depth)))
        T_cw = se3.inverse(pose(i))
        x, y, z, w = quaternion(T_cw)
        q, t = [w, x, y, z], T_cw[:3, 3].tolist()
        records = (
            struct.pack("<I7dI", i + 1, *q, *t, 5)
            + f"walk/{i}.png\0".encode()
            + (struct.pack("<Q", i) + i * struct.pack("<ddq", 1.0, 2.0, -1) + records)
        )
        lines += [" ".join(map(str, [i + 1, *q, *t, 5, f"walk/{i}.png"])), "1.0 2.0 -1" if i else ""]
    if binary:
        write(path / "sparse/0/cameras.bin", struct.pack("<QIiQQ4d", 1, 5, 1, 80, 60, *p))
        write(path / "sparse/0/images.bin", struct.pack("<Q", FRAMES) + records)
    else:
        write(path / "sparse/cameras.txt", "# cameras\n5 PINHOLE 80 60 " + " ".join(map(str, p)))
        write(path / "sparse/images.txt", "# images\n" + "\n".join(lines) + "\n")


def icl_nuim(path: Path) -> None:
    """Write what ICL-NUIM publishes, whose camera and world have y up: both are the mirrored ones."""
    camera = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
    mirror, rows = np.diag([1.0, -1.0, 1.0, 1.0]), []
    for i in range(FRAMES):
        rgb, depth = look(camera, pose(i))
        write(path / f"rgb/{i}.png", png(rgb))
        write(path / f"depth/{i}.png", png(np.rint(depth * 5000).astype(np.uint16)))
        T = mirror @ pose(i) @ mirror
        rows.append(" ".join(map(str, [i, *T[:3, 3], *quaternion(T)])))
    write(path / "livingRoom0.gt.freiburg", "\n".join(rows))


def bonn(path: Path) -> None:
    """Write a sequence of Bonn's dynamic scenes, whose truth is of a frame of markers."""
    axes = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    markers = np.array([[1.0157, 0.1828, -0.2389, 0.0113], [0.0009, -0.8431, -0.6413, -0.0098]])
    markers = np.vstack([markers, [-0.3009, 0.6147, -0.8085, 0.0111], [0, 0, 0, 1.0]])
    U, _, Vt = np.linalg.svd(markers[:3, :3])
    markers[:3, :3] = U @ Vt
    camera = Camera(640, 480, 542.822841, 542.576870, 315.593520, 237.756098)
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i in range(FRAMES):
        rgb, depth = look(camera, pose(i))
        write(path / f"rgb/{i}.png", png(rgb))
        write(path / f"depth/{i}.png", png(np.rint(depth * 5000).astype(np.uint16)))
        T = axes @ pose(i) @ np.linalg.inv(axes @ markers)
        for name in ("rgb", "depth"):
            lists[name].append(f"{1e9 + i / 30:.6f} {name}/{i}.png")
        lists["groundtruth"].append(" ".join(map(str, [1e9 + i / 30, *T[:3, 3], *quaternion(T)])))
    for name, lines in lists.items():
        write(path / f"{name}.txt", "\n".join(lines))


def replica_semantic(path: Path) -> None:
    """Write Replica as Semantic-NeRF renders it: 90 degrees wide, with the data set's own instances."""
    camera = Camera(80, 60, 40.0, 40.0, 39.5, 29.5)
    for i in range(FRAMES):
        rgb, depth = look(camera, pose(i))
        write(path / f"rgb/rgb_{i}.png", png(rgb))
        write(path / f"depth/depth_{i}.png", png(millimetres(depth)))
        write(path / f"semantic_instance/semantic_instance_{i}.png", png((depth < 1.9).astype(np.uint8) * 7))
        write(path / f"semantic_class/semantic_class_{i}.png", png(np.full(depth.shape, 3, np.uint8)))
    write(path / "traj_w_c.txt", "\n".join(" ".join(map(str, pose(i).ravel())) for i in range(FRAMES)))


def co_fusion(path: Path) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    rows = []
    for i in range(FRAMES):
        rgb, depth = look(COLOUR, pose(i))
        write(path / f"colour/Color{i + 1:04d}.png", png(rgb))
        ids = np.where(depth < 1.9, 2, 0).astype(np.uint8)
        write(path / f"mask_id/Mask{i + 1:04d}.png", png(np.stack([ids] * 3, axis=-1)))
        write(path / f"mask_colour/Mask{i + 1:04d}.png", png(rgb))
        for name, noise in (("depth_noise", 0.003), ("depth_original", 0.0)):
            (path / name).mkdir(exist_ok=True)
            seen = depth + np.float32(noise)
            seen[0, 0] = np.inf
            OpenEXR.File(header, {"Z": seen}).write(str(path / f"{name}/Depth{i + 1:04d}.exr"))
        rows.append(" ".join(map(str, [i + 1, *pose(i)[:3, 3], *quaternion(pose(i))])))
    for name in ("cam-0", "car-2"):
        write(path / f"trajectories/gt-{name}.txt", "\n".join(rows if name == "cam-0" else rows[::-1]))
    write(path / "calibration.txt", f"{COLOUR.fx} {COLOUR.fy} {COLOUR.cx + 0.5} {COLOUR.cy + 0.5} 80 60\n")


LAYOUTS: dict[str, Callable[[Path], object]] = {
    "stray": stray,
    "record3d": record3d_export,
    "polycam": polycam,
    "scanner-app": scanner_app,
    "arkitscenes": arkitscenes,
    "scannet": scannet,
    "scannetpp-stream": lambda path: scannetpp(path / "iphone", "stream"),
    "scannetpp-lz4": lambda path: scannetpp(path / "iphone", "lz4"),
    "scannetpp-deflate": lambda path: scannetpp(path, "deflate"),
    "7-scenes": seven_scenes,
    "7-scenes-info": bundle_fusion,
    "nerfstudio": nerfstudio,
    "nerfstudio-capture": lambda path: nerfstudio(path, capture=True),
    "icl-nuim": icl_nuim,
    "co-fusion": co_fusion,
    "replica-semantic": replica_semantic,
    "colmap-text": lambda path: colmap(path, binary=False),
    "colmap-binary": lambda path: colmap(path, binary=True),
}
"""Name, which begins with the kind that it is opened as -> what writes it into a folder."""
