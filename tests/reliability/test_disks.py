# SPDX-License-Identifier: Apache-2.0
"""Disks of a few megabytes: what was computed is kept where there is room, and nothing older is lost."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from ggwarp.results.saved_run import load_run
from office_runs import contents_of, start_run

FRAMES = ("--frames", "0:4")
RESULTS = ("trajectory.txt", "map.ply")
PICTURES = ("saving renders", "saving pictures", "writing the report")
"""What comes after the results, and may find no room."""


@pytest.fixture(scope="module", autouse=True)
def mounts(request: pytest.FixtureRequest) -> None:
    """A name space of one's own to mount in, which not every system grants."""
    if not request.config.getoption("--reliability"):
        pytest.skip("with --reliability")
    may = subprocess.run(
        ["unshare", "--map-root-user", "--mount", "mount", "-t", "tmpfs", "x", "/mnt"], capture_output=True
    )
    if may.returncode:
        pytest.skip("may not mount")


@pytest.fixture(scope="module")
def runs(mounts: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an ``earlier`` run, and what the run on small disks is to give: ``expected``."""
    folder = tmp_path_factory.mktemp("runs")
    for name, frames in (("earlier", ("--frames", "0:2")), ("expected", FRAMES)):
        with start_run(folder, *frames, "--out", name) as run:
            _, errors = run.communicate()
        assert run.returncode == 0, errors
    return folder


@dataclass(frozen=True)
class Disk:
    """A small disk for the folder ``name``.

    Attributes:
        files: a folder whose files it begins with, and which has the disk's in the end.
        size: as mount has it, such as "3m" or "30m,nr_inodes=6".
    """

    name: str
    files: Path
    size: str

    @property
    def room(self) -> int:
        """Bytes that it holds."""
        number, unit = self.size.partition(",")[0][:-1], self.size.partition(",")[0][-1]
        return int(number) * {"k": 1 << 10, "m": 1 << 20}[unit]


def mounted(disks: Sequence[Disk], folder: Path) -> str:
    """Return a shell's words that run "$@" where ``disks`` are mounted in ``folder``."""
    before, after = [], []
    for disk in disks:
        place = folder / disk.name
        before.append(f"mount -t tmpfs -o size={disk.size} tmpfs {place}")
        before.append(f"cp -a {disk.files}/. {place}/ 2>/dev/null")
        after.append(f"rm -rf {disk.files}; cp -a {place} {disk.files}")
    return "; ".join([*before, '"$@"; code=$?', *after, "exit $code"])


SIZES = (
    *(f"{kb}k" for kb in (8, 40, 100, 200, 400, 800, 1600)),
    *(f"{mb}m" for mb in (3, 6, 9, 12, 18, 24, 30)),
    *(f"30m,nr_inodes={n}" for n in (6, 14)),
)
CACHES = ("400k", "3m", "9m", "18m", "30m")
PLACES = (("out",), ("tmp",), ("cache",), ("out", "tmp"), ("out", "tmp", "cache"))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("which", PLACES, ids="+".join)
def test_a_small_disk(runs: Path, tmp_path: Path, which: tuple[str, ...], size: str) -> None:
    """For the folder of results, the temporary folder and the kernel cache, alone and together."""
    if "cache" in which and size not in CACHES:
        pytest.skip("all kernels are compiled each time")
    for name in ("out", "tmp", "cache"):
        (tmp_path / name).mkdir()
    disks = [Disk(name, tmp_path / f"{name}-kept", size) for name in which]
    for disk in disks:
        disk.files.mkdir()
    places = {name: tmp_path / (f"{name}-kept" if name in which else name) for name in ("out", "tmp")}
    earlier, expected = contents_of(runs / "earlier"), contents_of(runs / "expected")
    fits = 1.3 * sum(map(len, earlier.values())) < disks[0].room and "inodes" not in size
    if fits or "out" not in which:
        shutil.copytree(runs / "earlier", places["out"] / "run")
    else:
        earlier = {}
    variables = {"TMPDIR": str(tmp_path / "tmp")}
    if "cache" in which:
        variables["WARP_CACHE_PATH"] = str(tmp_path / "cache")
    options = (*FRAMES, "--out", "out/run", "--checkpoint-every", "1")
    with start_run(tmp_path, *options, inside=mounted(disks, tmp_path), **variables) as run:
        out, errors = run.communicate()
    where = f"{size} for {which}: exit {run.returncode}\n{out[-400:]}\n{errors}"
    print(where.splitlines()[0], "|", out.splitlines()[-1] if out else errors)
    assert "Traceback" not in errors, where
    in_place = contents_of(places["out"] / "run")
    if run.returncode == 2:  # before any work
        assert len([line for line in errors.splitlines() if not line.startswith("warning")]) == 1, where
        assert in_place == earlier and os.listdir(tmp_path / "tmp") == [], where
        return
    kept = _folder_that_is_named(out, tmp_path, places)
    for name in RESULTS:
        assert (kept / name).read_bytes() == expected[name], where
    assert len(load_run(kept).poses) == 4, where
    failures = json.loads((kept / "metrics.json").read_text())["failures"]
    if kept != places["out"] / "run":
        assert run.returncode == 1 and failures and in_place == earlier, where
    elif run.returncode == 0:
        assert failures == [] and _names(in_place) == _names(expected), where
    else:  # a whole run took its place, and what came of pictures had no room
        assert run.returncode == 1 and failures, where
        assert all(line.startswith(PICTURES) for line in failures), where


def _names(files: dict[str, bytes]) -> set[str]:
    return {name for name in files if not name.startswith("checkpoints/")}


def _folder_that_is_named(out: str, folder: Path, places: dict[str, Path]) -> Path:
    """Return where the last line says that the run is, in what was kept of the disks."""
    said = out.splitlines()[-1].partition(" in ")[2].rpartition(", as ")
    path = folder / (said[0] or said[2])
    top, *rest = path.relative_to(folder).parts
    return places.get(top, folder / top).joinpath(*rest)


def test_a_bind_mount_takes_a_run(start, contents, tmp_path: Path) -> None:
    for name in ("o", "disk"):
        (tmp_path / name).mkdir()
    words = f'mount --bind {tmp_path}/disk {tmp_path}/o && "$@"'
    for _ in range(2):  # the second takes the first's place
        with start(*FRAMES, "--out", "o", inside=words) as run:
            _, errors = run.communicate()
        assert run.returncode == 0 and errors == ""
        assert len(load_run(tmp_path / "disk").poses) == 4
        assert not [name for name in os.listdir(tmp_path / "disk") if name.startswith(".")]
        assert {p.name for p in tmp_path.iterdir()} == {"o", "disk"}


def test_a_disk_that_can_only_be_read(start, tmp_path: Path) -> None:
    (tmp_path / "o").mkdir()
    words = f'mount -t tmpfs -o ro tmpfs {tmp_path}/o && "$@"'
    with start(*FRAMES, "--out", "o/run", inside=words) as run:
        _, errors = run.communicate()
    assert run.returncode == 2 and errors == "ggwarp: o/run: Read-only file system\n"
