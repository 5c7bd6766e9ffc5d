# SPDX-License-Identifier: Apache-2.0
"""Depth in every format that is read: the same metres, whoever wrote the file."""

import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile

from ggwarp.datasets import DatasetError, FrameError, open_dataset
from ggwarp.datasets.images import read_depth

METRES = (np.arange(24 * 30, dtype=np.float32).reshape(24, 30) + 500) / 1000
METRES[3, 4] = 0.0


def _exr(path: Path, dtype: str, name: str = "R") -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: METRES.astype(dtype)}).write(str(path))


def _write(path: Path) -> None:
    millimetres = np.rint(METRES * 1000).astype(np.uint16)
    kind = path.stem
    if kind in ("uint16", "pgm"):
        assert cv2.imwrite(str(path), millimetres)
    elif kind == "tiff16":
        tifffile.imwrite(path, millimetres, byteorder=">")
    elif kind == "tiff32":
        tifffile.imwrite(path, METRES, compression="zlib")
    elif kind in ("half", "single"):
        _exr(path, {"half": "f2", "single": "f4"}[kind], "Z" if kind == "half" else "R")
    elif kind == "npy16":
        np.save(path, np.asfortranarray(millimetres))
    elif kind == "npy64":
        np.save(path, METRES.astype(">f8")[None])
    elif kind == "npz":
        np.savez_compressed(path, depth=METRES, confidence=METRES > 0)


FILES = [
    "uint16.png",
    "pgm.pgm",
    "tiff16.tif",
    "tiff32.tiff",
    "half.exr",
    "single.exr",
    "npy16.npy",
    "npy64.npy",
]


@pytest.mark.parametrize("name", [*FILES, "npz.npz"])
def test_every_format_gives_the_same_metres(tmp_path: Path, name: str) -> None:
    _write(tmp_path / name)
    depth = read_depth(tmp_path / name, scale=1000.0, size=(30, 24))
    assert depth.dtype == np.float32 and depth[3, 4] == 0.0
    np.testing.assert_allclose(depth, METRES, rtol=1e-3 if "half" in name else 1e-6)
    with pytest.raises(FrameError, match="30x24, but 31x24 is needed"):
        read_depth(tmp_path / name, scale=1000.0, size=(31, 24))


@pytest.mark.parametrize("name", ["half.exr", "tiff32.tiff", "npy64.npy", "npz.npz"])
@pytest.mark.parametrize("keep", [3, 0.2, 0.6, 0.97])
def test_a_file_cut_short_is_refused(tmp_path: Path, name: str, keep: float) -> None:
    path = tmp_path / name
    _write(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if keep < 1 else int(keep)])
    with pytest.raises(FrameError, match=name):
        read_depth(path, scale=1000.0)


def test_what_is_not_finite_is_no_reading(tmp_path: Path) -> None:
    values = np.ones((4, 5), np.float32)
    values[0] = [np.nan, np.inf, -np.inf, -1.0, 0.0]
    np.save(tmp_path / "d.npy", values)
    depth = read_depth(tmp_path / "d.npy", scale=1.0)
    assert (depth[0] == 0.0).all() and (depth[1:] == 1.0).all()


def test_what_claims_too_much_is_never_decoded(tmp_path: Path) -> None:
    big = 60_000
    header = str({"descr": "<f4", "fortran_order": False, "shape": (big, big)}).encode().ljust(117) + b"\n"
    (tmp_path / "d.npy").write_bytes(
        b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(64)
    )
    tags = [struct.pack("<HHII", tag, 4, 1, big) for tag in (256, 257)]
    (tmp_path / "d.tif").write_bytes(b"II*\x00" + struct.pack("<IH", 8, 2) + b"".join(tags) + bytes(64))
    box = struct.pack("<4i", 0, 0, big - 1, big - 1)
    (tmp_path / "d.exr").write_bytes(
        b"v/1\x01\x02\x00\x00\x00dataWindow\x00box2i\x00" + struct.pack("<i", 16) + box + b"\x00" + bytes(64)
    )
    for name in ("d.npy", "d.tif", "d.exr"):
        with pytest.raises(FrameError, match=f"{name}: claims to be 60000x60000"):
            read_depth(tmp_path / name, scale=1000.0)


def test_several_arrays_need_one_named_depth(tmp_path: Path) -> None:
    np.savez(tmp_path / "d.npz", a=METRES, b=METRES)
    with pytest.raises(FrameError, match="holds 2 arrays"):
        read_depth(tmp_path / "d.npz", scale=1.0)
    with zipfile.ZipFile(tmp_path / "e.npz", "w") as archive:
        archive.writestr("depth.npy", np.array([{}], object).dumps())
    with pytest.raises(FrameError, match=r"e\.npz: is no NumPy array"):
        read_depth(tmp_path / "e.npz", scale=1.0)
    np.save(tmp_path / "f.npy", np.zeros((4, 5, 3), np.float32))
    with pytest.raises(FrameError, match="one number a pixel"):
        read_depth(tmp_path / "f.npy", scale=1.0)


def test_a_folder_of_exr_depth_is_a_recording_with_depth(tmp_path: Path) -> None:
    for i in range(3):
        for folder in ("color", "depth"):
            (tmp_path / folder).mkdir(exist_ok=True)
        assert cv2.imwrite(str(tmp_path / f"color/{i}.png"), np.full((24, 30, 3), 90, np.uint8))
        _exr(tmp_path / f"depth/{i}.exr", "f2")
    (tmp_path / "camera.json").write_text('{"w": 30, "h": 24, "fx": 30, "fy": 30, "cx": 15, "cy": 12}')
    dataset = open_dataset(str(tmp_path), data_root=tmp_path)
    assert dataset.has_depth and len(dataset) == 3
    frame = dataset[1]
    assert frame.depth is not None
    np.testing.assert_allclose(frame.depth, METRES, rtol=1e-3)
    (tmp_path / "depth/0.exr").write_bytes(b"v/1\x01")
    with pytest.raises(DatasetError, match=r"0\.exr"):
        _ = dataset[0]
