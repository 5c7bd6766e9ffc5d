# SPDX-License-Identifier: Apache-2.0
"""Sequences of RGB-D frames: opening one, plain folders, what all layouts share."""

from __future__ import annotations

import contextlib
import importlib
import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ggwarp.datasets.base import (
    KINDS,
    Dataset,
    DatasetError,
    FrameError,
    Kind,
    MaskChoice,
    Masks,
    WithoutDepth,
    WithoutMasks,
    register,
)
from ggwarp.io.suggestion import did_you_mean

if TYPE_CHECKING:
    from ggwarp.datasets.built_in.faults import SensorFaults
    from ggwarp.datasets.built_in.synthetic import SyntheticOffice, SyntheticScene
    from ggwarp.datasets.calibration import Intrinsics
    from ggwarp.datasets.reader import BadFrame, FrameReader

__all__ = [
    "KINDS",
    "BadFrame",
    "Dataset",
    "DatasetError",
    "FrameError",
    "FrameReader",
    "Kind",
    "SyntheticOffice",
    "WithoutDepth",
    "is_live_source",
    "is_there",
    "open_dataset",
    "register",
]

APARTMENTS = ("apartment", "apartment-person", "apartment-kinect", "apartment-kinect-person")
"""The built-in apartment: seen perfectly or by a Kinect; with or without a person who walks through."""
BUILT_IN = ("office", "synthetic", "wall", *APARTMENTS)
"""Names that always mean a built-in scene: the wall, the apartment, or the office."""
OWN_KINDS = (
    "bags.reader",
    "phones.stray",
    "phones.record3d",
    "phones.polycam",
    "phones.scanner_app",
    "readers.arkitscenes",
    "readers.scannetpp",
    "readers.scannet",
    "readers.sens",
    "readers.seven_scenes",
    "readers.nerfstudio",
    "readers.colmap",
    "readers.icl_nuim",
    "readers.co_fusion",
    "readers.replica",
    "readers.tum",
    "folder",
)
"""The modules of the layouts that are read, in the order they are tried."""
LIVE = ("webcam:", "realsense:", "record3d:")
"""What begins so is a camera that is plugged in; ``-`` is frames on standard input."""
FALLBACK = "office0"
"""The one sequence that the built-in office stands in for where Replica is absent."""

_MOST_PLACES = 5  # that a message names
_MOST_INSIDE = 100  # entries of a folder that are looked into
_MOST_ENTRIES = 10_000  # of a folder that are compared with a name

# What needs OpenCV or Warp is imported when first used.
_LAZY = {
    "BadFrame": "ggwarp.datasets.reader",
    "FrameReader": "ggwarp.datasets.reader",
    "SyntheticOffice": "ggwarp.datasets.built_in.synthetic",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def open_dataset(
    seq: str,
    *,
    data_root: Path,
    masks: Masks = None,
    faults: SensorFaults | None = None,
    intrinsics: Intrinsics | None = None,
) -> Dataset:
    """Open a sequence by name or path.

    Args:
        seq: a name, looked up under ``data_root`` (also in its folders: Replica, TUM, ...), or a path; ``-``,
            ``webcam:0``, ``realsense:`` or ``record3d:``, whose frames come once. ``office`` is the built-in
            synthetic office, and so is ``office0`` where there is no Replica; ``wall`` is the built-in wall,
            and :data:`APARTMENTS` the built-in apartment.
        data_root: folder of the data sets; need not exist.
        masks: folder of the object masks; None: beside the images, if there; "none": not used.
        faults: of the camera of a built-in scene; None: it has none.
        intrinsics: fx, fy, cx, cy of one's own recording, in pixels of its native size; None: it says so.

    Raises:
        DatasetError: nothing of that name, an unknown layout, or unusable content.
    """
    if seq in BUILT_IN:
        _no_intrinsics(seq, intrinsics)
        return _built_in(seq, masks, faults)
    if is_live_source(seq):
        return _live(seq, masks, intrinsics)
    kinds = _kinds()
    candidates = _candidates(seq, Path(data_root))
    folders = [path for path in candidates if path.is_dir()]
    for path in folders:
        for kind in kinds:
            if kind.recognises(path) and kind.takes_intrinsics:
                return kind.open(path, masks, intrinsics)
            if kind.recognises(path):
                _no_intrinsics(f"{path} ({kind.name})", intrinsics)
                return kind.open(path, masks)
    if folders:
        if deeper := _deeper(folders[0], kinds):
            raise DatasetError(f"{folders[0]}: holds no sequence itself, but {deeper} is one: --seq {deeper}")
        layouts = "; ".join(f"{kind.name}: {kind.layout}" for kind in kinds)
        raise DatasetError(f"{folders[0]}: holds no sequence that is recognised ({layouts})")
    files = [path for path in candidates if path.is_file()]
    for path in files:
        for kind in kinds:
            if path.suffix.lower() in kind.suffixes:
                _no_intrinsics(f"{path} ({kind.name})", intrinsics)
                return kind.open(path, masks)
    if files:
        return _video(files[0], intrinsics)
    if seq == FALLBACK:
        return _built_in(seq, masks, faults)
    raise DatasetError(
        f"{seq}: no such sequence{_suggestion(seq, candidates)}; looked for {_places(candidates)} "
        f"(--data names another data root, ggwarp download fetches one, --seq office is built in)"
    )


def _deeper(folder: Path, kinds: list[Kind]) -> Path | None:
    """Return the first folder in ``folder``, or in these, that is a sequence; None: there is none."""
    inside = [path for path in sorted(itertools.islice(folder.iterdir(), _MOST_INSIDE)) if path.is_dir()]
    deeper = [
        p for path in inside for p in sorted(itertools.islice(path.iterdir(), _MOST_INSIDE)) if p.is_dir()
    ]
    found = (path for path in (*inside, *deeper) if any(kind.recognises(path) for kind in kinds))
    return next(found, None)


def is_there(seq: str, data_root: Path) -> bool:
    """Return whether :func:`open_dataset` finds something of that name, and would not stand in for it."""
    return seq in BUILT_IN or any(path.exists() for path in _candidates(seq, Path(data_root)))


def is_live_source(seq: str) -> bool:
    """Return whether ``seq`` means a source whose frames come once, as they are taken."""
    return seq == "-" or seq.startswith(LIVE)


def _live(seq: str, masks: Masks, intrinsics: Intrinsics | None) -> Dataset:
    from ggwarp.datasets.live.sequence import no_masks

    no_masks(masks, f"--seq {seq}")
    which = seq.partition(":")[2]
    if seq.startswith("webcam:"):
        from ggwarp.datasets.live.cameras import open_webcam

        return open_webcam(which, intrinsics)
    _no_intrinsics(f"--seq {seq}", intrinsics)
    if seq == "-":
        from ggwarp.datasets.live.stream import open_stream

        return open_stream()
    if seq.startswith("record3d:"):
        from ggwarp.datasets.live.record3d import open_record3d

        return open_record3d(which)
    from ggwarp.datasets.live.cameras import open_realsense

    return open_realsense(which)


def _kinds() -> list[Kind]:
    """Return the kinds in the order they are tried: the more particular first."""
    return [*KINDS, *(importlib.import_module(f"ggwarp.datasets.{name}").KIND for name in OWN_KINDS)]


def _candidates(seq: str, root: Path) -> list[Path]:
    """Return where ``seq`` may lie, in the order it is looked for."""
    from ggwarp.datasets.readers.tum import full_name

    given = Path(seq)
    with contextlib.suppress(RuntimeError):  # ~ of nobody who is known here
        given = given.expanduser()
    if given.is_absolute() or seq.startswith("."):
        return [given]
    names = [seq] + [name for name in [full_name(seq)] if name and name != seq]
    groups = [root, root / "Replica", root / "TUM"]
    if root.is_dir():
        groups += sorted(path for path in root.iterdir() if path.is_dir() and path not in groups)
    return [group / name for name in names for group in groups] + [given]


def _suggestion(seq: str, candidates: list[Path]) -> str:
    """Return the nearest name of what is there, beside each of the ``candidates``; empty: none is near."""
    there: set[str] = set()
    for parent in dict.fromkeys(path.parent for path in candidates):
        with contextlib.suppress(OSError, ValueError):
            there |= {entry.name for entry in itertools.islice(parent.iterdir(), _MOST_ENTRIES)}
    return did_you_mean(Path(seq).name, there.union(BUILT_IN, [FALLBACK]))


def _places(candidates: list[Path]) -> str:
    shown = ", ".join(str(path) for path in candidates[:_MOST_PLACES])
    more = len(candidates) - _MOST_PLACES
    return f"{shown} and {more} places more" if more > 0 else shown


def _no_intrinsics(what: str, intrinsics: Intrinsics | None) -> None:
    if intrinsics is not None:
        raise DatasetError(f"--intrinsics: the camera of {what} is known; leave the option out")


def _video(path: Path, intrinsics: Intrinsics | None) -> Dataset:
    from ggwarp.datasets.readers.video import VIDEO_SUFFIXES, VideoSequence

    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise DatasetError(
            f"{path}: is a file; --seq takes a sequence's folder or name, "
            f"or a video ({', '.join(VIDEO_SUFFIXES)})"
        )
    return VideoSequence(path, intrinsics)


def _built_in(seq: str, masks: Masks, faults: SensorFaults | None) -> Dataset:
    scene = _built_in_scene(seq, faults)
    choice = MaskChoice.of(masks)
    if choice.where is None:
        return scene
    if str(choice.where) == "none":
        return WithoutMasks(scene)
    from ggwarp.datasets.masks import WithMasks, open_masks

    size = (scene.camera.width, scene.camera.height)
    return WithMasks(scene, open_masks(Path(choice.where), scene.stems, size=size, void=choice.void))


def _built_in_scene(seq: str, faults: SensorFaults | None) -> SyntheticScene:
    from ggwarp.datasets.built_in.apartment import SyntheticApartment
    from ggwarp.datasets.built_in.faults import SensorFaults
    from ggwarp.datasets.built_in.synthetic import SyntheticOffice, SyntheticWall

    faults = faults or SensorFaults()
    if seq in APARTMENTS:
        return SyntheticApartment(kinect="kinect" in seq, person="person" in seq, faults=faults)
    return (SyntheticWall if seq == "wall" else SyntheticOffice)(faults=faults)
