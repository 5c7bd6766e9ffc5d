# SPDX-License-Identifier: Apache-2.0
"""Per-frame object masks, in the three forms that segmenters write.

- ``object_mask/<stem>.png``: one channel, 8 or 16 bits, the value is the id.
- ``Annotations/<stem>.png``: RGB-coded, id = R + 256 G + 65536 B (DEVA's long ids).
- ``Annotations/<stem>.png``: a palette image, the palette index is the id (DEVA's short ids).

0 = no object. The form is told by the file, not by the folder.
"""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import Dataset, DatasetError, FrameError, Masks, at_scale
from ggwarp.datasets.formats.headers import PNG_SIGNATURE
from ggwarp.datasets.images import decode, png_chunks, read_bytes
from ggwarp.datasets.resize import resize_nearest
from ggwarp.geometry.camera import Camera
from ggwarp.types import Frame

log = logging.getLogger(__name__)

MASK_FOLDERS = ("object_mask", "Annotations")
MOST_IDS = 4096
"""Most ids of one mask, and at most one per 20 pixels: a mask of more is a picture of something else."""
_ALWAYS_IDS = 256  # what 8 bits hold is never too much
_PIXELS_PER_ID = 20
_PALETTE = 3  # PNG colour type


class MaskFolder:
    """The object masks of a sequence."""

    def __init__(self, folder: Path, stems: Sequence[str]) -> None:
        """Match the masks in ``folder`` with the frames whose image stems are ``stems``."""
        self.folder = folder
        present = {path.stem for path in folder.glob("*.png")}
        self._found = [folder / f"{stem}.png" if stem in present else None for stem in stems]
        self._warned_size = False
        self._warned_ids = False

    @property
    def count(self) -> int:
        """Number of frames that have a mask."""
        return sum(path is not None for path in self._found)

    def read(self, index: int, width: int, height: int) -> NDArray[np.int32] | None:
        """Return frame ``index``'s object ids [height, width]; None where there is no mask.

        A mask of another size is resampled by nearest neighbour, with one warning a sequence;
        an unreadable one counts as missing, with a warning: the frame itself is good. So does one with more
        ids than a segmenter finds, with one warning a sequence: colours in a mask's place would all be ids.
        """
        path = self._found[index]
        if path is None:
            return None
        try:
            ids = read_mask(path)
        except FrameError as error:
            log.warning("%s: frame %d goes without a mask", error, index)
            return None
        if self._too_many_ids(ids, path):
            return None
        if ids.shape != (height, width):
            if not self._warned_size:
                log.warning(
                    "%s: %dx%d, but the colour image is %dx%d; masks are resampled (nearest neighbour)",
                    path,
                    ids.shape[1],
                    ids.shape[0],
                    width,
                    height,
                )
                self._warned_size = True
            ids = resize_nearest(ids, width, height)
        return ids

    def _too_many_ids(self, ids: NDArray[np.int32], path: Path) -> bool:
        most = max(_ALWAYS_IDS, min(MOST_IDS, ids.size // _PIXELS_PER_ID))
        if int(ids.max(initial=0)) < most:
            return False
        present = np.zeros(int(ids.max()) + 1, np.bool_)
        present[ids] = True
        count = np.count_nonzero(present)
        if count > most and not self._warned_ids:
            log.warning(
                "%s: holds %d ids, more than %d: is it a picture of ids? Such masks are left aside",
                path,
                count,
                most,
            )
            self._warned_ids = True
        return bool(count > most)


class WithMasks:
    """A data set as it is, but with the masks of a folder."""

    has_masks = True

    def __init__(self, dataset: Dataset, masks: MaskFolder, *, drawn_for: Camera | None = None) -> None:
        """Join them.

        Args:
            drawn_for: the camera whose size the masks should have; default: the data set's.
        """
        self.name, self.kind, self.camera = dataset.name, dataset.kind, dataset.camera
        self.has_depth = dataset.has_depth
        self.inner = dataset
        self.class_names: dict[int, str] = getattr(dataset, "class_names", {})
        self._masks = masks
        self._drawn_for = drawn_for or dataset.camera

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: int) -> Frame:
        mask = self._masks.read(index, self._drawn_for.width, self._drawn_for.height)
        if mask is not None:
            mask = resize_nearest(mask, self.camera.width, self.camera.height)
        return replace(self.inner[index], mask=mask)

    def scaled(self, scale: float) -> WithMasks:
        """Return the same with frames of ``scale`` times the size, where the data set renders them."""
        return WithMasks(at_scale(self.inner, scale), self._masks, drawn_for=self._drawn_for)


def find_masks(sequence: Path, stems: Sequence[str], masks: Masks = None) -> MaskFolder | None:
    """Find the masks of a sequence.

    Args:
        sequence: the sequence's folder.
        stems: stem of each frame's colour image.
        masks: a folder that holds ``<stem>.png``, or ``object_mask/`` or ``Annotations/`` that
            does; None: look in ``sequence``; "none": do without.

    Raises:
        DatasetError: a folder was named, but has no mask of any frame.
    """
    if masks is not None:
        return None if str(masks) == "none" else open_masks(Path(masks), stems)
    return _first_with_masks([sequence / name for name in MASK_FOLDERS], stems)


def open_masks(given: Path, stems: Sequence[str]) -> MaskFolder:
    """Open a folder that holds ``<stem>.png``, or ``object_mask/`` or ``Annotations/`` that does.

    Raises:
        DatasetError: it is no folder, or has no mask of any frame.
    """
    if not given.is_dir():
        raise DatasetError(f"{given}: no such folder; --masks names a folder of <image stem>.png, or none")
    found = _first_with_masks([given, *(given / name for name in MASK_FOLDERS)], stems)
    if found is None:
        example = f"{stems[0]}.png" if stems else "<image stem>.png"
        raise DatasetError(
            f"{given}: holds no mask of any frame; masks are named as the images, such as {example}"
        )
    return found


def _first_with_masks(folders: list[Path], stems: Sequence[str]) -> MaskFolder | None:
    for folder in folders:
        if folder.is_dir() and (found := MaskFolder(folder, stems)).count:
            return found
    return None


def find_true_masks(sequence: Path, stems: Sequence[str], given: MaskFolder | None) -> MaskFolder | None:
    """Find the masks beside the images where ``given`` are others: what those are measured against.

    Args:
        sequence, stems: as for :func:`find_masks`.
        given: the masks in use; None: none, and so nothing to measure.
    """
    own = None if given is None else find_masks(sequence, stems)
    if given is None or own is None or own.folder.resolve() == given.folder.resolve():
        return None
    return own


def write_mask(path: Path, ids: NDArray[np.int32]) -> None:
    """Write object ids [h, w] as ``object_mask/`` has them; RGB-coded where 16 bits do not hold them.

    Raises:
        OSError: the file cannot be written.
        ValueError: an id is negative, or above 2^24 - 1.
    """
    largest = int(ids.max(initial=0))
    if ids.min(initial=0) < 0 or largest >= 1 << 24:
        raise ValueError(f"{path}: ids {ids.min()} to {largest}; a mask holds 0 to {(1 << 24) - 1}")
    if largest < 1 << 16:
        image = ids.astype(np.uint8 if largest < 1 << 8 else np.uint16)
    else:
        image = np.stack([ids >> 16, (ids >> 8) & 255, ids & 255], axis=2).astype(np.uint8)  # BGR
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def read_mask(path: Path) -> NDArray[np.int32]:
    """Return the object ids [h, w] of a mask file, in any of the three forms; 0 = no object.

    Raises:
        FrameError: the file is missing, damaged or of none of the forms.
    """
    data = read_bytes(path)
    palette = _without_palette(data, path)
    if palette is not None:
        grey, bits = palette
        # OpenCV spreads fewer bits over 0..255.
        return (decode(grey, path, cv2.IMREAD_UNCHANGED) // (255 // (2**bits - 1))).astype(np.int32)
    image = decode(data, path, cv2.IMREAD_UNCHANGED)
    if image.ndim == 2:
        return image.astype(np.int32)
    if image.dtype != np.uint8 or image.shape[2] < 3:
        raise FrameError(
            f"{path}: {image.shape[2]} channels of {image.dtype}; RGB-coded ids are 8 bits a channel"
        )
    blue, green, red = (image[..., channel].astype(np.int32) for channel in range(3))
    return red + 256 * green + 65536 * blue


def _without_palette(data: bytes, path: Path) -> tuple[bytes, int] | None:
    """Return a palette PNG as a grey one of the same indices, and its bits a pixel; else None.

    OpenCV turns a palette into colours, of which two indices may share one.
    """
    if not data.startswith(PNG_SIGNATURE):
        return None
    chunks = list(png_chunks(data, path))
    header = chunks[0][1]
    if len(header) != 13 or header[9] != _PALETTE or header[8] not in (1, 2, 4, 8):
        return None
    grey = bytearray(PNG_SIGNATURE)
    for kind, content in chunks:
        if kind == b"IHDR":
            content = header[:9] + b"\x00" + header[10:]
        elif kind not in (b"IDAT", b"IEND"):
            continue
        grey += struct.pack(">I", len(content)) + kind + content
        grey += struct.pack(">I", zlib.crc32(kind + content))
    return bytes(grey), header[8]
