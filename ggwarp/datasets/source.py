# SPDX-License-Identifier: Apache-2.0
"""Where the parts of a sequence come from, as its reader knows it: said before a run, and kept with it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from ggwarp.io.printable import printable

_MOST_SHOWN = 6
_OURS = frozenset({"README", "README.txt", "README.md", "LICENSE", "LICENSE.txt"})
"""Files that tell people something."""


@dataclass(frozen=True)
class Source:
    """What a reader knows of where a sequence's parts come from; empty: it does not say.

    Attributes:
        layout: what kind of folder or file, in words, such as "Replica, results/".
        pairing: how colour and depth were paired, see :meth:`ggwarp.datasets.pairing.Pairing.summary`.
        camera: the file or option that gives the camera.
        depth_unit: what a metre counts in the files and who says so, such as "1000 a metre (camera.json)".
        truth: the file of true poses, how many there are and by which convention.
        notes: what may be wrong, a line each: shown as warnings.
        unread: what is there and is not read, such as "depths/ (20 .png)".
    """

    layout: str = ""
    pairing: str = ""
    camera: str = ""
    depth_unit: str = ""
    truth: str = ""
    notes: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()


NO_SOURCE = Source()


def source_of(dataset: object) -> Source:
    """Return the source of a data set, or of the one that it wraps; an empty one where none is told."""
    while not isinstance(found := getattr(dataset, "source", None), Source):
        inner = getattr(dataset, "inner", None)
        if inner is None:
            return NO_SOURCE
        dataset = inner
    return found


def unread_entries(folder: Path, read: Iterable[Path]) -> tuple[str, ...]:
    """Return what lies in ``folder`` and is not among ``read`` (files, or whole folders), in words.

    Hidden files and what only people read is passed over; of a folder, its name and what is in it are told.
    """
    known = set(read)
    found: list[str] = []
    files: list[Path] = []
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return ()
    for path in entries:
        if path in known or path.name.startswith(".") or path.name in _OURS:
            continue
        if path.is_dir():
            found.append(f"{printable(path.name)}/ ({contents(path)})")
        else:
            files.append(path)
    if len(files) > _MOST_SHOWN:
        found.append(count_by_suffix(files))
    else:
        found += [printable(path.name) for path in files]
    return tuple(found)


def depth_elsewhere(unread: Iterable[str], remedy: str) -> list[str]:
    """Return which folders among the ``unread`` probably hold the depth that is missed, with the remedy."""
    return [
        f"{entry} is not read: {remedy}"
        for entry in unread
        if "/ (" in entry and "depth" in entry.split("/")[0].lower()
    ]


def contents(folder: Path) -> str:
    """Return what a folder holds in words: "20 .png, 1 .json", "2 folders", "empty"."""
    try:
        entries = list(folder.iterdir())
    except OSError:
        return "cannot be read"
    folders = sum(path.is_dir() for path in entries)
    files = [path for path in entries if path.suffix and not path.name.startswith(".")]
    parts = [count_by_suffix(files)] if files else []
    if folders:
        parts.append(f"{folders} folder{'s' * (folders > 1)}")
    return ", ".join(parts) or "empty"


def count_by_suffix(files: Iterable[Path]) -> str:
    """Return how many of ``files`` there are of each kind, the most first: "20 .png, 1 .json"."""
    counts: dict[str, int] = {}
    for path in files:
        counts[path.suffix.lower()] = counts.get(path.suffix.lower(), 0) + 1
    ranked = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    shown = [f"{count} {printable(suffix) or 'without a suffix'}" for suffix, count in ranked[:_MOST_SHOWN]]
    return ", ".join(shown + ["..."] * (len(ranked) > _MOST_SHOWN))


class HasDepthAndPose(Protocol):
    """A frame's entry, as far as :func:`recorder_source` looks at it."""

    @property
    def depth(self) -> object: ...
    @property
    def T_wc(self) -> object: ...
    @property
    def confidence(self) -> object: ...


def recorder_source(
    layout: str,
    entries: Sequence[HasDepthAndPose],
    *,
    camera: str,
    depth_unit: str,
    truth: str,
    notes: Iterable[str] = (),
    unread: tuple[str, ...] = (),
) -> Source:
    """Return the source of what a recorder wrote: names tell what belongs together, the layout what is what.

    Args:
        layout, camera, depth_unit, notes, unread: as :class:`Source` has them.
        truth: where poses come from, such as "odometry.csv, by ARKit".
    """
    count = len(entries)
    depth, sure, poses = (
        sum(getattr(entry, name) is not None for entry in entries) for name in ("depth", "confidence", "T_wc")
    )
    pairing = "by name"
    if 0 < depth < count:
        pairing += f"; {count - depth} of {count} colour images have no depth"
    if sure:
        pairing += "; depth counts by its confidence, without the least"
    return Source(
        layout=layout,
        pairing=pairing if depth else "",
        camera=camera,
        depth_unit=depth_unit if depth else "",
        truth=f"{truth}, poses of {poses} of {count} frames" if poses else "",
        notes=tuple(notes),
        unread=unread,
    )


def whole_numbers(files: Iterable[Path]) -> dict[int, Path]:
    """Return the files whose stem is a whole number, by it."""
    return {int(f.stem): f for f in files if f.stem.isascii() and f.stem.isdigit() and len(f.stem) < 19}
