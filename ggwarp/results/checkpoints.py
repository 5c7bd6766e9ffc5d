# SPDX-License-Identifier: Apache-2.0
"""A run's checkpoints: ``checkpoints/NNNNNN.safetensors`` in its folder, the last two of them."""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ggwarp.io.checkpoint import read_checkpoint, write_checkpoint
from ggwarp.io.guarded import FileError
from ggwarp.io.lock import in_use
from ggwarp.io.printable import printable

FOLDER = "checkpoints"

_NAME = re.compile(r"\d{6,9}\.safetensors")
_KEPT = 2
_STAGED = re.compile(r"\.(?:(?P<name>.+)\.)?partial-\d+(?:-\d+)?")
_APART = re.compile(r"(?:(?P<name>.+)-)?incomplete(?:-\d+)?")


def checkpoint_files(folder: Path) -> list[Path]:
    """Return the checkpoints of the run in ``folder``, the newest first."""
    with contextlib.suppress(OSError):
        names = [path for path in (folder / FOLDER).iterdir() if _NAME.fullmatch(path.name)]
        return sorted(names, key=lambda path: int(path.stem), reverse=True)
    return []


def is_worth_keeping(folder: Path) -> bool:
    """Return whether a run left something in ``folder``: a checkpoint, or both a trajectory and a map."""
    results = ("trajectory.txt", "map.ply")
    return bool(checkpoint_files(folder)) or all((folder / name).is_file() for name in results)


def kept_in(folder: Path) -> str:
    """Return, for the user, where an unfinished run is, and what can be done with it."""
    if checkpoint_files(folder):
        return f"kept in {folder}; ggwarp run --resume {folder} goes on"
    return f"kept in {folder}, as it was saved last"


def save_checkpoint(folder: Path, tree: dict[str, Any]) -> None:
    """Write a checkpoint of the run in ``folder``; of older ones, only the last stays.

    Raises:
        OSError: it cannot be written; those that there were stay.
    """
    (folder / FOLDER).mkdir(exist_ok=True)
    older = checkpoint_files(folder)
    number = int(older[0].stem) + 1 if older else 1
    write_checkpoint(folder / FOLDER / f"{number:06d}.safetensors", tree)
    unfinished = (folder / FOLDER).glob(".*.part")  # of a run that was killed
    for path in (*older[_KEPT - 1 :], *unfinished):
        path.unlink(missing_ok=True)


@dataclass(frozen=True)
class FoundRun:
    """A run that can go on.

    Attributes:
        folder: holds its checkpoints.
        target: where it belongs when it is done.
    """

    folder: Path
    target: Path

    def load(self) -> tuple[dict[str, Any], list[str]]:
        """Return its newest checkpoint that can be read, and what is wrong with newer ones.

        Raises:
            FileError: none can be read.
        """
        faults: list[str] = []
        for path in checkpoint_files(self.folder):
            try:
                return read_checkpoint(path), faults
            except FileError as error:
                faults.append(str(error))
        raise FileError("; ".join(faults))


def find_run(run: Path) -> FoundRun:
    """Return where the run that is meant by ``run`` can go on.

    That is a run's own name, whether it is done or was killed on its way, or the folder that it left. What a
    killed run left goes before the finished one whose place it was to take.

    Raises:
        FileError: there is none, or it is still going on.
    """
    name = printable(str(run))
    real = Path(os.path.realpath(run))
    unpublished = target_of(real) is not None
    left = [] if unpublished else [path for path in leftovers(real) if not is_superseded(path, real)]
    folder = next((path for path in left if checkpoint_files(path)), real)
    for path in {folder, *left}:
        if path != real or unpublished:
            if path.is_dir() and in_use(path):
                raise FileError(f"{name}: this run is still going on; stop it first")
    if not checkpoint_files(folder):
        others = [path for path in kept_apart(real) if checkpoint_files(path)]
        hint = (
            f"; {printable(str(others[-1]))} has some" if others else "; start the run anew without --resume"
        )
        what = "has no checkpoint" if real.is_dir() else "no such run"
        raise FileError(f"{name}: {what}{hint}")
    return FoundRun(folder, (target_of(folder) or run) if unpublished else run)


def leftovers(target: Path) -> list[Path]:
    """Return the staging folders of runs into ``target``, those with the newest files first."""
    found: list[Path] = []
    for parent in (target.parent, target):
        with contextlib.suppress(OSError):
            found += [path for path in parent.iterdir() if _STAGED.fullmatch(path.name)]
    return sorted((path for path in found if target_of(path) == target), key=started_ns, reverse=True)


def kept_apart(target: Path) -> list[Path]:
    """Return the folders that unfinished runs into ``target`` were kept in, the newest last."""
    found: list[Path] = []
    for parent in (target.parent, target):
        with contextlib.suppress(OSError):
            found += [path for path in parent.iterdir() if _APART.fullmatch(path.name)]
    return sorted((path for path in found if target_of(path) == target), key=started_ns)


def is_superseded(left: Path, target: Path) -> bool:
    """Return whether the run in ``target`` is newer than what was ``left`` of another: it took its place."""
    return started_ns(left) <= started_ns(target)


def started_ns(folder: Path) -> int:
    """Return when the run in ``folder`` began, or went on, nanoseconds; 0: there is none."""
    with contextlib.suppress(OSError):
        return (folder / "config.toml").stat().st_mtime_ns
    return 0


def target_of(folder: Path) -> Path | None:
    """Return where the run in ``folder`` was to be; None: it is there."""
    match = _STAGED.fullmatch(folder.name) or _APART.fullmatch(folder.name)
    if match is None:
        return None
    return folder.with_name(match["name"]) if match["name"] else folder.parent


def put_apart(folder: Path, target: Path, *, inside: bool) -> Path:
    """Rename what is left of a run into ``target`` to a name of its own, which is returned."""
    base = target / "incomplete" if inside else target.with_name(f"{target.name}-incomplete")
    path, again = base, 1
    while path.exists():
        again += 1
        path = base.with_name(f"{base.name}-{again}")
    os.rename(folder, path)
    return path
