# SPDX-License-Identifier: Apache-2.0
"""What a data set is, how it fails, and the register of the kinds there are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from ggwarp.geometry.camera import Camera
from ggwarp.types import Frame


class DatasetError(ValueError):
    """The data cannot be used: one line for the user, with the file, the value and the remedy."""


class FrameError(DatasetError):
    """One frame of a sequence cannot be used; the others can."""


class SequenceEnd(Exception):
    """A live sequence has no more frames."""


MOST_LIVE_FRAMES = 1 << 20
"""What a live sequence claims to have: nine hours at 30 a second."""


@runtime_checkable
class Dataset(Protocol):
    """A sequence of frames at their native size.

    Attributes:
        name: the sequence's name.
        kind: the layout that it is read from: "replica", "tum", "folder", "video", "synthetic", ...
        camera: the camera of every frame, at its native size.
        has_depth: whether frames carry depth.
        has_masks: whether frames carry object masks (single ones may still be missing).

    A data set that knows what its objects are has ``class_names``, too: mask id -> name.
    """

    name: str
    kind: str
    camera: Camera
    has_depth: bool
    has_masks: bool

    def __len__(self) -> int:
        """Return the number of frames."""
        ...

    def __getitem__(self, index: int) -> Frame:
        """Return frame ``index``, at native size.

        Raises:
            FrameError: the frame's files are missing, damaged or of the wrong size.
            IndexError: ``index`` is outside 0..len-1.
        """
        ...


def is_live(dataset: object) -> bool:
    """Return whether the frames of ``dataset``, or of the one that it wraps, come once and end some time."""
    while dataset is not None and not hasattr(dataset, "live"):
        dataset = getattr(dataset, "inner", None)
    return bool(getattr(dataset, "live", False))


def dropped_frames(dataset: object) -> int:
    """Return how many pictures of a live ``dataset``, or of the one that it wraps, were not waited for."""
    while dataset is not None and not hasattr(dataset, "dropped"):
        dataset = getattr(dataset, "inner", None)
    return int(getattr(dataset, "dropped", 0))


class WithoutMasks:
    """A data set as it is, but for its masks."""

    has_masks = False

    def __init__(self, dataset: Dataset) -> None:
        self.name, self.kind, self.camera = dataset.name, dataset.kind, dataset.camera
        self.has_depth = dataset.has_depth
        self.stems: list[str] = getattr(dataset, "stems", [])
        self.inner = dataset

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: int) -> Frame:
        return replace(self.inner[index], mask=None, native_mask=None, true_mask=None)


class WithoutDepth:
    """A data set as it is, but for its depth."""

    has_depth = False

    def __init__(self, dataset: Dataset) -> None:
        self.name, self.kind, self.camera = dataset.name, dataset.kind, dataset.camera
        self.has_masks = dataset.has_masks
        self.inner = dataset

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: int) -> Frame:
        return replace(
            self.inner[index], depth=None, sensor_depth=None, depth_weight=None, depth_timestamp=None
        )


@runtime_checkable
class Scalable(Protocol):
    """A data set that renders its frames, and so gives them at any size without resampling."""

    def scaled(self, scale: float) -> Dataset:
        """Return the same data set with frames of ``scale`` times the size."""
        ...


def at_scale(dataset: Dataset, scale: float) -> Dataset:
    """Return ``dataset`` at ``scale`` where it renders its frames, else as it is."""
    if isinstance(dataset, (WithoutMasks, WithoutDepth)):
        return type(dataset)(at_scale(dataset.inner, scale))
    return dataset.scaled(scale) if isinstance(dataset, Scalable) else dataset


@dataclass(frozen=True)
class MaskChoice:
    """Where the object masks are, and which of their ids say nothing.

    Attributes:
        where: a folder; None: beside the images, if there; "none": not used.
        void: ids of pixels that are neither an object nor none.
    """

    where: str | Path | None = None
    void: tuple[int, ...] = ()

    @classmethod
    def of(cls, masks: Masks) -> MaskChoice:
        """Return ``masks`` as a choice."""
        return masks if isinstance(masks, MaskChoice) else cls(masks)


Masks = str | Path | None | MaskChoice
"""Where the object masks are: a folder; None: beside the images, if there; "none": not used; or a choice."""


@dataclass(frozen=True)
class Kind:
    """A kind of data set on disk.

    Attributes:
        name: its name, as ``Dataset.kind`` has it.
        layout: what marks such a folder, for messages.
        recognises: whether a folder is of this kind; only looks at names.
        open: opens a folder of this kind; raises DatasetError.
        suffixes: of the files, as a folder's stead, that are of this kind, such as ".r3d".
        takes_intrinsics: whether ``open`` takes the camera's, or None, as a third argument.
    """

    name: str
    layout: str
    recognises: Callable[[Path], bool]
    open: Callable[..., Dataset]
    takes_intrinsics: bool = False
    suffixes: tuple[str, ...] = ()


KINDS: list[Kind] = []
"""The kinds that others have registered; they are tried before the package's own."""


def register(kind: Kind) -> None:
    """Make ``kind`` known to :func:`ggwarp.datasets.open_dataset`."""
    KINDS.append(kind)
