# SPDX-License-Identifier: Apache-2.0
"""Per-frame object masks beside a sequence or in a folder of their own; see :mod:`.formats.mask_file`."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ggwarp.datasets.base import Dataset, DatasetError, FrameError, MaskChoice, Masks, at_scale
from ggwarp.datasets.formats.mask_checks import interpolated, too_many_ids, without_edges
from ggwarp.datasets.formats.mask_file import Ids, read_mask_file
from ggwarp.datasets.images import shown_size, size_of
from ggwarp.datasets.pairing import in_order, pair_files
from ggwarp.datasets.resize import resize_labels
from ggwarp.datasets.source import contents, source_of
from ggwarp.geometry.camera import Camera
from ggwarp.types import Frame

log = logging.getLogger(__name__)

MASK_FOLDERS = ("object_mask", "Annotations")
VOID = -1
"""Of pixels that say nothing: neither an object nor none."""
_LIKE_MASKS = re.compile(r"(?i)mask|seg|instance|label")
_SAMPLES = 5  # masks that are looked at when a folder is opened
_SAME_SHAPE = 0.02  # of the aspect: the rounding of a small mask


class _Matched(NamedTuple):
    """Each frame's mask, or None, what they were matched by, and what is odd about that, a line each."""

    masks: list[Path | None]
    by: str
    notes: list[str]


class MaskFolder:
    """The object masks of a sequence.

    Attributes:
        folder: where they are.
        void: ids of pixels that say nothing.
        clean_edges: whether ids that lie only along edges are left out: the masks were interpolated.
        notes: what is odd about them, a line each.
    """

    def __init__(
        self,
        folder: Path,
        stems: Sequence[str],
        *,
        size: tuple[int, int] | None = None,
        void: Sequence[int] = (),
        matched: _Matched | None = None,
    ) -> None:
        """Match the masks in ``folder`` with the frames whose image stems are ``stems``, and look at a few.

        Args:
            size: (width, height) of the frames, pixels, whose shape the masks must have; None: any.
            void: ids of pixels that say nothing.
            matched: each frame's mask, where that has been found out; None: not yet.

        Raises:
            DatasetError: they are of another shape than the frames, none can be read, or they are no masks.
        """
        self.folder = folder
        self.void = tuple(sorted(set(void)))
        self._found, self._by, self.notes = matched or _matched(folder, stems)
        self._warned: set[str] = set()
        self._forms: set[str] = set()
        self._size = size
        self.clean_edges = False
        if self.count:
            self._look()

    @property
    def count(self) -> int:
        """Number of frames that have a mask."""
        return sum(path is not None for path in self._found)

    @property
    def text(self) -> str:
        """What the masks are, in words."""
        forms = ", ".join(sorted(self._forms))
        return f"{self.folder.name}/, {self.count} of {len(self._found)} frames, by {self._by}; {forms}"

    def read(self, index: int) -> Ids | None:
        """Return frame ``index``'s object ids [H, W] at their own size; None where there is no mask.

        Pixels of void ids, and those along the edges of interpolated masks, are :data:`VOID`. An unreadable
        mask counts as missing, with a warning: the frame itself is good. So does one of another shape than
        the frames, and one with more ids than a segmenter finds, with one warning a sequence each: colours in
        a mask's place would all be ids.
        """
        path = self._found[index]
        if path is None:
            return None
        try:
            ids = read_mask_file(path).ids
        except FrameError as error:
            self._warn_once(str(path), f"{error}: frame {index} goes without a mask")
            return None
        for kind, fault in (("shape", self._shape_fault(ids)), ("ids", too_many_ids(ids))):
            if fault:
                self._warn_once(kind, f"{path}: {fault}; such masks are left aside")
                return None
        return self._cleaned(ids)

    def _cleaned(self, ids: Ids) -> Ids:
        if self.clean_edges:
            ids = without_edges(ids, VOID)
        return np.where(np.isin(ids, self.void), VOID, ids).astype(np.int32) if self.void else ids

    def _look(self) -> None:
        """Look at a few masks, spread over the sequence, and at what they have in common.

        Raises:
            DatasetError: all of them are of another shape than the frames, damaged, or something else.
        """
        present = [path for path in self._found if path is not None]
        places = np.linspace(0, len(present) - 1, min(_SAMPLES, len(present))).astype(int)
        chosen = [present[int(place)] for place in places]
        masks, faults = [], []
        for path in chosen:
            try:
                mask = read_mask_file(path)
            except FrameError as error:
                if len(chosen) > 1:  # a single one may be damaged
                    faults.append(str(error))
                continue
            self._forms.add(mask.form)
            if fault := self._shape_fault(mask.ids) or too_many_ids(mask.ids):
                faults.append(f"{path}: {fault}")
            else:
                masks.append(mask.ids)
        if faults and not masks:
            raise DatasetError(f"{faults[0]}; --masks none does without")
        self.notes = [f"{self.folder}: {note}" for note in self.notes]
        if reason := interpolated(masks):
            self.clean_edges = True
            self.notes.append(f"{self.folder}: {reason}")
        if self._size is not None and masks and size_of(masks[0]) != self._size:
            sizes = f"{shown_size(size_of(masks[0]))}, but the colour image is {shown_size(self._size)}"
            self.notes.append(f"{chosen[0]}: {sizes}; masks are resampled")

    def _shape_fault(self, ids: Ids) -> str:
        if self._size is None:
            return ""
        (height, width), (w, h) = ids.shape, self._size
        if abs(width * h / (height * w) - 1.0) <= _SAME_SHAPE:
            return ""
        turned = ", turned by a quarter?" if abs(height * h / (width * w) - 1.0) <= _SAME_SHAPE else ""
        return f"is {width}x{height}, of another shape than the {w}x{h} images{turned}"

    def _warn_once(self, kind: str, line: str) -> None:
        if kind not in self._warned:
            log.warning("%s", line)
            self._warned.add(kind)


def _matched(folder: Path, stems: Sequence[str]) -> _Matched:
    """Return which mask in ``folder`` is whose."""
    files = in_order([path for path in folder.glob("*.png") if not path.name.startswith(".")])
    try:
        pairing = pair_files([Path(f"{stem}.png") for stem in stems], files, "images", "masks")
    except DatasetError:
        return _Matched([None] * len(stems), "name", [])
    found = [files[i] if i >= 0 else None for i in pairing.partners]
    return _Matched(found, pairing.by, pairing.notes)


class WithMasks:
    """A data set as it is, but with the masks of a folder."""

    has_masks = True

    def __init__(self, dataset: Dataset, masks: MaskFolder) -> None:
        """Join them."""
        self.name, self.kind, self.camera = dataset.name, dataset.kind, dataset.camera
        self.has_depth = dataset.has_depth
        self.inner = dataset
        self.class_names: dict[int, str] = getattr(dataset, "class_names", {})
        self.masks_text = masks.text
        source = source_of(dataset)
        self.source = replace(source, notes=(*source.notes, *masks.notes))
        self._masks = masks

    def __len__(self) -> int:
        return len(self.inner)

    def __getitem__(self, index: int) -> Frame:
        return with_mask(self.inner[index], self._masks.read(index), self.camera)

    def scaled(self, scale: float) -> WithMasks:
        """Return the same with frames of ``scale`` times the size, where the data set renders them."""
        return WithMasks(at_scale(self.inner, scale), self._masks)


def with_mask(frame: Frame, ids: Ids | None, camera: Camera) -> Frame:
    """Return ``frame`` with a mask [H, W] of any size, also resampled to the size of ``camera``."""
    if ids is None:
        return replace(frame, mask=None, native_mask=None)
    mask = resize_labels(ids, camera.width, camera.height)
    return replace(frame, mask=mask, native_mask=None if mask is ids else ids)


def find_masks(
    sequence: Path,
    stems: Sequence[str],
    masks: Masks = None,
    *,
    size: tuple[int, int] | None = None,
) -> MaskFolder | None:
    """Find the masks of a sequence.

    Args:
        sequence: the sequence's folder.
        stems: stem of each frame's colour image.
        masks: a folder that holds masks named or numbered as the images, or a folder that does; None: look in
            ``sequence``; "none": do without.
        size: see :class:`MaskFolder`.

    Raises:
        DatasetError: a folder was named, but has no mask of any frame; or what is there are no masks.
    """
    choice = MaskChoice.of(masks)
    where, void = choice.where, choice.void
    if where is not None:
        return None if str(where) == "none" else open_masks(Path(where), stems, size=size, void=void)
    return _first_with_masks([sequence / name for name in MASK_FOLDERS], stems, size, void)


def masks_left_out(sequence: Path, stems: Sequence[str], masks: Masks = None) -> Iterator[str]:
    """Yield what lies in ``sequence`` like masks, though :func:`find_masks` of the same found none."""
    if MaskChoice.of(masks).where is not None:
        return
    for folder in sorted(path for path in sequence.iterdir() if path.is_dir()):
        if folder.name in MASK_FOLDERS and any(folder.iterdir()):
            yield (
                f"{folder}: holds {contents(folder)}, but no PNG with the name or number of an image, one an "
                "image: objects are not learnt"
            )
        elif _LIKE_MASKS.search(folder.name) and _has_masks(folder, stems):
            names = " and ".join(f"{name}/" for name in MASK_FOLDERS)
            yield f"{folder}: is not read; masks are looked for in {names}, or where --masks says"


def open_masks(
    given: Path,
    stems: Sequence[str],
    *,
    size: tuple[int, int] | None = None,
    void: Sequence[int] = (),
) -> MaskFolder:
    """Open a folder of masks, or one that holds ``object_mask/`` or ``Annotations/``, or a folder in these.

    Raises:
        DatasetError: it is no folder, has no mask of any frame, several folders in it have, or what is there
            are no masks.
    """
    if not given.is_dir():
        raise DatasetError(f"{given}: no such folder; --masks names a folder of <image stem>.png, or none")
    folders = [given, *(given / name for name in MASK_FOLDERS)]
    if found := _first_with_masks(folders, stems, size, void):
        return found
    deeper = [p for folder in folders if folder.is_dir() for p in sorted(folder.iterdir()) if p.is_dir()]
    having = [folder for folder in deeper if _has_masks(folder, stems)]
    if len(having) == 1:
        return MaskFolder(having[0], stems, size=size, void=void)
    if having:
        names = ", ".join(str(folder) for folder in having[:5])
        raise DatasetError(f"{given}: several folders in it hold masks of the frames ({names}); name one")
    example = f"{stems[0]}.png" if stems else "<image stem>.png"
    jpegs = "; JPEG changes ids, so that masks must be PNG" if _has_jpegs(folders) else ""
    raise DatasetError(
        f"{given}: holds no mask of any frame ({contents(given)}); masks are named or numbered as the "
        f"images, such as {example}{jpegs}"
    )


def _has_jpegs(folders: Sequence[Path]) -> bool:
    return any(any(folder.glob("*.jp*g")) for folder in folders)


def _first_with_masks(
    folders: list[Path], stems: Sequence[str], size: tuple[int, int] | None, void: Sequence[int]
) -> MaskFolder | None:
    for folder in filter(Path.is_dir, folders):
        matched = _matched(folder, stems)
        if any(matched.masks):
            return MaskFolder(folder, stems, size=size, void=void, matched=matched)
    return None


def _has_masks(folder: Path, stems: Sequence[str]) -> bool:
    return folder.is_dir() and any(_matched(folder, stems).masks)


def find_true_masks(
    sequence: Path, stems: Sequence[str], given: MaskFolder | None, *, size: tuple[int, int] | None = None
) -> MaskFolder | None:
    """Find the masks beside the images where ``given`` are others: what those are measured against.

    Args:
        sequence, stems, size: as for :func:`find_masks`.
        given: the masks in use; None: none, and so nothing to measure.
    """
    if given is None:
        return None
    for folder in (sequence / name for name in MASK_FOLDERS):
        if folder.resolve() == given.folder.resolve():
            return None
        if _has_masks(folder, stems):
            return MaskFolder(folder, stems, size=size, void=given.void)
    return None
