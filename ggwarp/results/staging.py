# SPDX-License-Identifier: Apache-2.0
"""A run folder with a promise: what was there stays whole until the new run is, and is then replaced at once.

A run writes into ``.NAME.partial-PID`` beside its target ``NAME``; the two are exchanged when all is saved.
A target that cannot be renamed (a mount point, the current folder, a parent that cannot be written to) holds
the staging folder itself, and its files are then replaced one by one. The staging folder is locked while its
run lives, so that what a killed run left is told from what a living one writes.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import re
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from ggwarp.io.lock import in_use, lock_folder
from ggwarp.io.mounts import is_mount
from ggwarp.results.checkpoints import FOLDER, is_superseded, is_worth_keeping, put_apart, target_of
from ggwarp.results.run_folder import OUTPUTS

_FOLDERS = ("renders", "pictures", FOLDER)
_PICTURE = re.compile(r"renders/frame\d+_\w+\.png|pictures/(frame\d+_\w+|object\d+)\.jpg")
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # of Linux's renameat2


class StagedFolder:
    """The folder of one run, while it is written and afterwards.

    Attributes:
        target: where the run will be; None with ``out``: ``runs/<sequence>/<UTC time>``.
        path: where its files are now: the staging folder, then the target.
        linked: whether ``runs/latest`` will show it.
    """

    def __init__(
        self, out: Path | None, sequence: str, *, adopted: Path | None = None, linked: bool = False
    ) -> None:
        """Look at the target; nothing is made or changed yet.

        Args:
            out: the folder; None: ``runs/<sequence>/<UTC time>``, with a link ``runs/latest``.
            adopted: the folder that an unfinished run into ``out`` left, to go on in; None: a new one.
            linked: have the link show ``out``, too.

        Raises:
            OSError: it is no folder, or it holds something else than a run.
        """
        self._adopted = adopted
        self._dated = out is None
        self.linked = linked or out is None
        if out is None:
            stamp = time.strftime("%Y-%m-%dT%H-%M-%SZ", time.gmtime())
            out = Path("runs") / (re.sub(r"[^\w.-]+", "_", sequence) or "sequence") / stamp
        elif out.exists() and not out.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "is no folder; choose another --out", str(out))
        self.target = self.path = out
        # Of a link to a folder, it is the folder that is replaced.
        self._real = Path(os.path.realpath(out))
        if _holds_others(self._real, [*self._leftovers(), adopted]):
            reason = "holds other files and no run, and is left alone; choose another --out"
            raise FileExistsError(errno.EEXIST, reason, str(out))
        self._inside = False
        self._made: list[Path] = []
        self._lock: int | None = None

    @property
    def replaces_a_run(self) -> bool:
        """Whether the target holds an earlier run."""
        return holds_run(self._real)

    def nearest(self) -> Path:
        """Return :attr:`path`, or while that is not made its nearest parent that is there."""
        return next(p for p in (self.path, *self.path.absolute().parents) if p.is_dir())

    def create(self) -> dict[Path, Path | None]:
        """Make the staging folder, or take over the one to go on in.

        Returns:
            What killed runs had left, now removed; or where it is now, if it is worth keeping.

        Raises:
            OSError: it cannot be made.
        """
        try:
            return self._create()
        except OSError as error:
            error.filename = str(self.target)  # not the name of a folder that nobody knows
            raise

    def publish(self) -> None:
        """Put the run where it belongs, at once and whole; then ``runs/latest`` shows it.

        Raises:
            OSError: it cannot be done; :attr:`path` is then still the staging folder.
        """
        sync_folder(self.path)
        if self._dated:
            self._move_to_free_name()
        elif self._inside:
            _replace_files(self.path, self._real)
        elif not self._real.exists():
            os.rename(self.path, self._real)
        else:
            _exchange(self.path, self._real)
            self._clear(self.path)
        sync_folder(self._real.parent)
        self.path = self.target
        self._unlock()
        if self.linked:
            _link_latest(self.target)

    def keep_apart(self) -> None:
        """Give what is not whole a name of its own beside the target: the earlier run stays in its place.

        Raises:
            OSError: it cannot be renamed; :attr:`path` is then still the staging folder.
        """
        shown = self._real if self.target.is_symlink() else self.target
        self.path = put_apart(self.path, shown, inside=self._inside)
        self._unlock()

    def discard(self, *, whole: bool = False) -> Path | None:
        """Remove the staging folder and what was made for it; the target is as it was.

        Args:
            whole: also where it is worth keeping.

        Returns:
            Where the folder is now, if it is kept; None: it is gone.
        """
        if self.path == self.target:
            return None
        if is_worth_keeping(self.path) and not whole:
            with contextlib.suppress(OSError):
                self.keep_apart()
            return self.path
        shutil.rmtree(self.path, ignore_errors=True)
        self.path = self.target
        self._unlock()
        for folder in self._made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        return None

    def _create(self) -> dict[Path, Path | None]:
        parent = self._real.parent
        self._make_parents(parent)
        if self._adopted is not None:
            self._lock = lock_folder(self._adopted)
        found = {left: None for left in self._leftovers() if left != self._adopted and not in_use(left)}
        cleared = {left: self._clear_or_keep(left) for left in found}
        self._inside = _cannot_be_renamed(self._real)
        base = self._real / f".partial-{os.getpid()}"
        if not self._inside:
            base = parent / f".{self._real.name}.partial-{os.getpid()}"
        path, again = base, 1
        while True:
            try:
                if self._adopted is None:
                    path.mkdir()
                elif path.exists():
                    raise FileExistsError
                else:
                    os.rename(self._adopted, path)
                break
            except FileExistsError:
                again += 1
                path = base.with_name(f"{base.name}-{again}")
        self.path = path
        if self._adopted is None:
            self._lock = lock_folder(path)
        return cleared

    def name_target(self, error: BaseException) -> None:
        """Have ``error`` name a file where it will be, not in a folder that nobody knows."""
        if isinstance(error, OSError) and isinstance(error.filename, str):
            error.filename = error.filename.replace(str(self.path), str(self.target), 1)

    def _make_parents(self, parent: Path) -> None:
        missing = [p for p in (parent, *parent.parents) if not p.exists()]
        parent.mkdir(parents=True, exist_ok=True)
        self._made = missing  # innermost first

    def _leftovers(self) -> Iterator[Path]:
        """Yield the staging folders of other runs into the same target, and old runs half replaced."""
        # Beside a folder named after the time, those of any time.
        name = r"\d{4}-\d\d-\d\dT[\d-]+Z[\d-]*" if self._dated else re.escape(self._real.name)
        with contextlib.suppress(OSError):
            for path in sorted(self._real.parent.iterdir()):
                if re.fullmatch(rf"\.{name}\.(partial|old)-\d+(-\d+)?", path.name):
                    yield path
        with contextlib.suppress(OSError):
            for path in sorted(self._real.iterdir()):
                if re.fullmatch(r"\.partial-\d+(-\d+)?", path.name):
                    yield path

    def _clear_or_keep(self, left: Path) -> Path | None:
        """Remove ``left``, or return its new name where it is worth keeping and no later run replaced it."""
        target = target_of(left)
        if target is None or not is_worth_keeping(left) or is_superseded(left, target):
            self._clear(left)
            return None
        return put_apart(left, target, inside=left.parent == target)

    def _clear(self, left: Path) -> None:
        """Remove ``left``; an earlier run goes back where nothing replaced it, and a user's files stay."""
        if ".old-" in left.name and not self._real.exists():
            os.rename(left, self._real)
            return
        if left.parent != self._real:
            _carry_over(left, self._real)
        shutil.rmtree(left, ignore_errors=True)

    def _move_to_free_name(self) -> None:
        """Rename to the target, or where another run of this second has taken it, to one like it."""
        again, name = 1, self.target.name
        while self._real.exists():
            again += 1
            self.target = self.target.with_name(f"{name}-{again}")
            self._real = self._real.with_name(self.target.name)
        os.rename(self.path, self._real)

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def holds_run(folder: Path) -> bool:
    """Return whether ``folder`` is a run's: with its configuration, or with what :func:`load_run` reads."""
    found = {name for name in OUTPUTS if (folder / name).is_file()}
    return {"map.ply", "trajectory.txt"} <= found or (
        "config.toml" in found and not found.isdisjoint({"camera.json", "metrics.json", "map.ply"})
    )


def sync_folder(folder: Path) -> None:
    """Have the names in ``folder`` written to the disk, where the system can do that for folders."""
    with contextlib.suppress(OSError):
        file = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(file)
        finally:
            os.close(file)


def _holds_others(folder: Path, ours: list[Path | None]) -> bool:
    if not folder.is_dir() or holds_run(folder):
        return False
    # A file in the place of the renders' folder stays, and only they cannot be written.
    return any(p not in ours and (p.name != "renders" or p.is_dir()) for p in folder.iterdir())


def _cannot_be_renamed(target: Path) -> bool:
    if not target.exists():
        return False
    here = Path(os.path.realpath("."))
    return (
        is_mount(target) or target == here or target in here.parents or not os.access(target.parent, os.W_OK)
    )


def _exchange(new: Path, target: Path) -> None:
    """Exchange two folders' names; in one step where the system knows such a step."""
    with contextlib.suppress(OSError, AttributeError):
        if sys.platform == "linux":
            call = ctypes.CDLL(None, use_errno=True).renameat2
            if call(_AT_FDCWD, os.fsencode(new), _AT_FDCWD, os.fsencode(target), _RENAME_EXCHANGE) == 0:
                return
    old = target.with_name(f".{target.name}.old-{os.getpid()}")
    os.rename(target, old)
    try:
        os.rename(new, target)
    except OSError:
        os.rename(old, target)
        raise
    os.rename(old, new)


def _is_output(path: Path) -> bool:
    """Return whether ``path``, relative to a run folder, is what a run writes."""
    if path.parts[0] == FOLDER:
        return len(path.parts) == 2 and path.suffix == ".safetensors"
    return str(path) in OUTPUTS or _PICTURE.fullmatch(path.as_posix()) is not None


def _carry_over(old: Path, new: Path) -> None:
    """Move what no run writes from ``old`` to ``new``: a user's notes in a run folder stay in it."""
    for path in sorted(old.iterdir()) if new.is_dir() else ():
        inside = sorted(path.iterdir()) if path.name in _FOLDERS and path.is_dir() else [path]
        for one in inside:
            name = one.relative_to(old)
            unfinished = one.name.startswith(".") and one.name.endswith(".part")
            if _is_output(name) or unfinished or (new / name).exists():
                continue
            (new / name).parent.mkdir(exist_ok=True)
            os.rename(one, new / name)


def _replace_files(new: Path, target: Path) -> None:
    """Replace a run's files one by one: where the folder itself cannot be."""
    fresh = [p.relative_to(new) for p in sorted(new.rglob("*")) if p.is_file()]
    for name in fresh:
        (target / name).parent.mkdir(exist_ok=True)
        os.replace(new / name, target / name)
    for path in (*target.iterdir(), *(p for name in _FOLDERS for p in (target / name).glob("*"))):
        name = path.relative_to(target)
        if name not in fresh and _is_output(name):
            path.unlink()
    shutil.rmtree(new, ignore_errors=True)
    sync_folder(target)


def _link_latest(folder: Path) -> None:
    link = Path("runs") / "latest"
    part = link.with_name(f".latest.{os.getpid()}")
    with contextlib.suppress(OSError):  # a file system without links: the run itself does not need it
        if link.is_symlink() or not link.exists():
            part.unlink(missing_ok=True)
            part.symlink_to(os.path.relpath(folder, link.parent), target_is_directory=True)
            os.replace(part, link)
