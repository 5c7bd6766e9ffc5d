# SPDX-License-Identifier: Apache-2.0
"""A sequence of image files: what every kind of data set on disk is once its lists are read."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets.base import DatasetError, FrameError, Masks
from ggwarp.datasets.calibration import Calibration
from ggwarp.datasets.images import (
    COLOUR_SUFFIXES,
    Size,
    WrongSizeError,
    read_colour,
    read_confidence,
    read_depth,
    shown_size,
    size_of,
    weighted,
)
from ggwarp.datasets.masks import find_masks, find_true_masks, masks_left_out, with_mask
from ggwarp.datasets.pairing import frame_numbers, in_order
from ggwarp.datasets.resize import resize_labels
from ggwarp.datasets.source import NO_SOURCE, Source
from ggwarp.geometry.camera import Camera
from ggwarp.io.camera import camera_fault, size_fault
from ggwarp.io.guarded import FileError, inside
from ggwarp.types import Float32, Float64, Frame

_MAY_FLOAT = {".exr", ".npy", ".npz", ".tif", ".tiff"}


@dataclass(frozen=True)
class Picture:
    """A picture without a file of its own: in a video, an archive, a bag.

    Attributes:
        path: what messages name, such as ``scan.r3d/rgbd/12.jpg``.
        read: returns colour [h, w, 3] uint8 RGB, depth [h, w] float32 metres, or confidence [h, w] uint8;
            raises FrameError.
    """

    path: Path
    read: Callable[[], NDArray[Any]]

    @property
    def stem(self) -> str:
        """What the picture is called, as a file's stem."""
        return self.path.stem

    def __str__(self) -> str:
        return str(self.path)


@dataclass(frozen=True)
class Entry:
    """The files and values of one frame.

    Attributes:
        rgb: the colour image.
        depth: the depth image; None where there is none.
        timestamp: seconds.
        T_wc: [4, 4] true camera-to-world pose, when known.
        depth_timestamp: seconds, when the depth was taken; None: together with the colour.
        camera: the colour camera of this frame, where it is another than the sequence's.
        confidence: an image of the depth's size that says how far each reading is to be trusted.
    """

    rgb: Path | Picture
    depth: Path | Picture | None
    timestamp: float
    T_wc: Float64 | None = None
    depth_timestamp: float | None = None
    camera: Camera | None = None
    confidence: Path | Picture | None = None


class FileSequence:
    """A :class:`ggwarp.datasets.base.Dataset` read from image files.

    Colour (and masks, drawn on colour) are undistorted where the calibration has a distortion, and depth is
    brought onto colour's pixels: see :mod:`ggwarp.datasets.rig`. Where readings have a confidence, it is
    their weight (:func:`ggwarp.datasets.images.weighted`).
    """

    def __init__(
        self,
        root: Path,
        kind: str,
        entries: Sequence[Entry],
        calibration: Calibration,
        *,
        masks: Masks = None,
        source: Source = NO_SOURCE,
    ) -> None:
        """Open the sequence.

        Args:
            source: where its parts come from; what the calibration and the masks know is added here.

        Raises:
            DatasetError: there is no frame, no frame is usable, or ``masks`` is wrong.
        """
        if not entries:
            raise DatasetError(f"{root}: the sequence is empty")
        self.name = root.resolve().name
        self.kind = kind
        self.camera: Camera = calibration.camera
        self._root = root
        self._entries = list(entries)
        self.depth_scale = calibration.depth_scale
        """What a metre counts in the depth images that are of whole numbers."""
        self._calibration = calibration
        if fault := size_fault(**dataclasses.asdict(self.camera)):  # nothing of it could be held
            raise DatasetError(f"{root}: its camera cannot be right: {fault}")
        self._rig = calibration.rig()
        self.stems = [entry.rgb.stem for entry in entries]
        """Each frame's name, as its mask has it."""
        size = (self.camera.width, self.camera.height)
        self._masks = find_masks(root, self.stems, masks, size=size)
        self._true_masks = find_true_masks(root, self.stems, self._masks, size=size)
        folders = [folder for folder in (self._masks, self._true_masks) if folder is not None]
        self._mask_notes = [note for folder in folders for note in folder.notes]
        if self._masks is None and root.is_dir():
            self._mask_notes = list(masks_left_out(root, self.stems, masks))
        self.masks_text = self._masks.text if self._masks else ""
        self.frames_with_depth = [i for i, entry in enumerate(entries) if entry.depth]
        self.has_depth = bool(self.frames_with_depth)
        self.has_masks = self._masks is not None
        self.source = self._completed(source)
        self._depth_size: Size | None = None  # that of the first that is read
        self._probe()
        if fault := camera_fault(**dataclasses.asdict(self.camera)):
            raise DatasetError(f"{root}: its camera cannot be right: {fault}")

    def _completed(self, source: Source) -> Source:
        """Return ``source`` with what the calibration and the masks know."""
        calibration, unread = self._calibration, source.unread
        if self._masks is not None:  # what they are in is read
            folder = self._masks.folder
            unread = tuple(u for u in unread if not folder.is_relative_to(self._root / u.split("/ (")[0]))
        return dataclasses.replace(
            source,
            camera=source.camera or calibration.origin,
            depth_unit=source.depth_unit or self._depth_unit(),
            notes=(*source.notes, *calibration.notes, *self._mask_notes),
            unread=unread,
        )

    def _depth_unit(self) -> str:
        """Return the depth's unit in words; floating point is metres."""
        unit = self._calibration.depth_unit
        suffixes = {entry.depth.suffix for entry in self._entries if isinstance(entry.depth, Path)}
        if suffixes == {".exr"}:
            return "metres, in floating point"
        return (f"metres, or of whole numbers {unit}" if suffixes & _MAY_FLOAT else unit) if suffixes else ""

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self._entries):
            raise IndexError(index)
        entry = self._entries[index]
        taken = entry.camera or self.camera
        rgb = self._rig.colour(self._colour(entry, (taken.width, taken.height)), entry.camera)
        depth, weight = self._depth(entry)
        frame = Frame(
            index,
            entry.timestamp,
            rgb,
            depth,
            T_wc=entry.T_wc,
            depth_timestamp=entry.depth_timestamp,
            depth_weight=weight,
        )
        if self._true_masks:
            frame = dataclasses.replace(frame, true_mask=self._seen(self._true_masks.read(index), taken))
        return with_mask(
            frame, self._seen(self._masks.read(index), taken) if self._masks else None, self.camera
        )

    def depth_of(self, index: int) -> Float32 | None:
        """Return frame ``index``'s depth alone, as the frame has it.

        Raises:
            FrameError: as indexing.
        """
        return self._depth(self._entries[index])[0]

    def mask_of(self, index: int) -> NDArray[np.int32] | None:
        """Return frame ``index``'s mask [h, w] alone, as the frame has it; None where there is none."""
        taken = self._entries[index].camera or self.camera
        ids = self._seen(self._masks.read(index), taken) if self._masks else None
        return None if ids is None else resize_labels(ids, self.camera.width, self.camera.height)

    def _seen(self, labels: NDArray[np.int32] | None, taken: Camera) -> NDArray[np.int32] | None:
        """Return labels drawn on pictures of the camera ``taken`` as the frames' camera sees them."""
        if labels is None or not self._rig.bends(taken):
            return labels
        return self._rig.labels(resize_labels(labels, taken.width, taken.height), taken)

    def _colour(self, entry: Entry, size: Size) -> NDArray[np.uint8]:
        try:
            if isinstance(entry.rgb, Path):
                return read_colour(self._inside(entry.rgb), size)
            rgb = entry.rgb.read()
            if size_of(rgb) != size:
                raise WrongSizeError(entry.rgb.path, size_of(rgb), size)
            return rgb
        except WrongSizeError as error:
            raise FrameError(
                f"{entry.rgb}: {error.found[0]}x{error.found[1]}, but the camera file says "
                f"{size[0]}x{size[1]}; correct the camera file, or export the image again"
            ) from None

    def _depth(self, entry: Entry) -> tuple[Float32 | None, Float32 | None]:
        """Return depth and, where its readings are not all as sure, their weights."""
        if not self.has_depth:
            return None, None
        if entry.depth is None:
            raise FrameError(f"{entry.rgb}: there is no depth image of this frame")
        if isinstance(entry.depth, Path):
            depth = read_depth(self._inside(entry.depth), scale=self.depth_scale)
        else:
            depth = entry.depth.read()
        if not self._rig.fits(*size_of(depth)):
            raise FrameError(f"{entry.depth}: {shown_size(size_of(depth))}, but {self._rig.wanted_depth}")
        if self._depth_size is None:
            self._depth_size = size_of(depth)
        elif size_of(depth) != self._depth_size:
            raise FrameError(
                f"{entry.depth}: {shown_size(size_of(depth))}, but other depth images are "
                f"{shown_size(self._depth_size)}; export it again"
            )
        weights = None
        if entry.confidence is not None:
            depth, weights = weighted(depth, self._confidence(depth, entry.confidence))
        if weights is not None:
            weights = self._rig.weights(weights, entry.camera)
        return self._rig.depth(depth, entry.camera), weights

    def _confidence(self, depth: Float32, source: Path | Picture) -> NDArray[np.uint8]:
        """Return the confidence of each reading of ``depth``."""
        confidence = read_confidence(self._inside(source)) if isinstance(source, Path) else source.read()
        if confidence.shape != depth.shape:
            raise FrameError(
                f"{source}: {shown_size(size_of(confidence))}, but the depth is {shown_size(size_of(depth))}"
            )
        return confidence

    def _inside(self, path: Path) -> Path:
        try:
            return inside(self._root, path)
        except FileError as error:
            raise FrameError(str(error)) from error

    def _probe(self) -> None:
        """Fail now, not after a thousand warnings, when no frame can be used."""
        last = len(self) - 1
        first_error: FrameError | None = None
        for index in sorted({0, last // 2, last}):
            try:
                self[index]
                return
            except FrameError as error:
                first_error = first_error or error
        raise DatasetError(str(first_error))


def image_files(folder: Path, prefix: str = "", suffixes: Sequence[str] = COLOUR_SUFFIXES) -> list[Path]:
    """Return ``folder``'s files of ``suffixes``, whose names start with ``prefix``, by number, then name."""
    files = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and path.name.startswith(prefix) and not path.name.startswith(".")
    ]
    return in_order(files)


def match_poses(paths: Sequence[Path], poses: Sequence[Float64 | None]) -> list[Float64 | None]:
    """Return each image's pose out of a list of one a line.

    Line i belongs to the i-th image when there are as many; to image number i otherwise (a
    recording of which images were deleted), None where there is no such line.
    """
    if len(poses) == len(paths):
        return list(poses)
    numbers = frame_numbers(paths)
    return [poses[n] if n is not None and n < len(poses) else None for n in numbers]
