# SPDX-License-Identifier: Apache-2.0
"""Arrays in files that are no images for OpenCV: NumPy's .npy and .npz, and OpenEXR."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ggwarp.datasets.base import FrameError
from ggwarp.datasets.formats.headers import check_size
from ggwarp.io.guarded import IMAGE
from ggwarp.io.printable import printable

NPY_SIGNATURE = b"\x93NUMPY"
ZIP_SIGNATURE = b"PK\x03\x04"
_HEADER_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_numpy(data: bytes, path: Path) -> NDArray:
    """Return the one image [h, w] that a .npy or .npz file holds; axes of length one are dropped.

    Nothing is allocated before the header has been compared with the bytes that are there, and no pickle
    is loaded.

    Raises:
        FrameError: the file is damaged, or holds no image or several.
    """
    try:
        if data.startswith(NPY_SIGNATURE):
            return _array(io.BytesIO(data), path)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
            if len(entries) > 1:
                entries = [entry for entry in entries if entry.filename == "depth.npy"]
            if len(entries) != 1:
                raise FrameError(
                    f"{path}: holds {len(archive.namelist())} arrays; one, or one named depth, is read"
                )
            if entries[0].file_size > IMAGE.limit:
                raise FrameError(f"{path}: claims {entries[0].file_size:,} bytes, more than any image")
            with archive.open(entries[0]) as stream:
                return _array(io.BytesIO(stream.read(IMAGE.limit)), path)
    except (FrameError, MemoryError):
        raise
    # Whatever zipfile, its decompressors and NumPy raise for damaged bytes: a dozen types.
    except Exception as error:
        reason = printable(str(error)) or type(error).__name__
        raise FrameError(f"{path}: is no NumPy array that can be read ({reason}); copy it again") from None


def _array(stream: BinaryIO, path: Path) -> NDArray:
    version = npy.read_magic(stream)
    shape, fortran, dtype = _HEADER_READERS[version](stream)
    sides = [side for side in shape if side != 1] if len(shape) > 2 else list(shape)
    if dtype.kind not in "uif" or len(sides) != 2:
        raise FrameError(
            f"{path}: holds {dtype} of shape {shape}; one number a pixel, [height, width], is read"
        )
    check_size(sides[1], sides[0], path)
    data = stream.read()
    if len(data) != sides[0] * sides[1] * dtype.itemsize:
        raise FrameError(f"{path}: is truncated after {len(data)} bytes of its array; copy it again")
    flat = np.frombuffer(data, dtype)
    return flat.reshape(sides, order="F" if fortran else "C")


def read_exr(path: Path) -> NDArray:
    """Return the one channel, or of several the one named Z, V, Y, R or depth, of an OpenEXR image [h, w].

    The caller has compared the size that the header claims.

    Raises:
        FrameError: OpenEXR is not installed, the file is damaged, or has no such channel.
    """
    try:
        import OpenEXR
    except ImportError:
        raise FrameError(f"{path}: needs OpenEXR; pip install OpenEXR") from None
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except MemoryError:
        raise
    except Exception as error:  # the library's own, and what NumPy makes of them
        reason = printable(str(error).replace("\n", " ")) or type(error).__name__
        raise FrameError(f"{path}: is no EXR image that can be read ({reason}); copy it again") from None
    if not channels:
        raise FrameError(f"{path}: is an EXR image without pixels that can be read; copy it again")
    names = [name for name in ("Z", "depth", "V", "Y", "R") if name in channels]
    if not names and len(channels) != 1:
        raise FrameError(
            f"{path}: has the channels {printable(', '.join(channels))}; depth is Z, Y or the only one"
        )
    image = channels[names[0]] if names else next(iter(channels.values()))
    if image.ndim != 2:
        raise FrameError(f"{path}: its channel has the shape {image.shape}; one number a pixel is read")
    return image
