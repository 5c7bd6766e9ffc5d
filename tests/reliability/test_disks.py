# SPDX-License-Identifier: Apache-2.0
"""Disks of a few megabytes: what was computed is kept where there is room, and nothing older is lost."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from ggwarp.io.ply import read_ply
from ggwarp.io.trajectory import read_tum
from ggwarp.results.saved_run import load_run

FRAMES = ("--frames", "0:4")


@pytest.fixture(autouse=True)
def mounts(campaign: bool) -> None:
    """A name space of one's own to mount in, which not every system grants."""
    if not campaign:
        pytest.skip("with --reliability")
    may = subprocess.run(
        ["unshare", "--map-root-user", "--mount", "mount", "-t", "tmpfs", "x", "/mnt"], capture_output=True
    )
    if may.returncode:
        pytest.skip("may not mount")


def small(place: str, size: str, files: Path) -> str:
    """Return a shell's words that run "$@" where ``place`` is a disk of ``size``, whose files are kept."""
    return (
        f"mount -t tmpfs -o size={size} tmpfs {place} && cp -a {files}/. {place}/ 2>/dev/null; "
        f'"$@"; code=$?; rm -rf {files}; cp -a {place} {files}; exit $code'
    )


SIZES = (
    *(f"{kb}k" for kb in (8, 40, 100, 200, 400, 800, 1600)),
    *(f"{mb}m" for mb in (3, 6, 9, 12, 18, 24, 30)),
    *(f"30m,nr_inodes={n}" for n in (6, 14)),
)
PLACES = (("out",), ("tmp",), ("cache",), ("out", "tmp"), ("out", "tmp", "cache"))


@pytest.mark.parametrize("which", PLACES, ids="+".join)
def test_small_disks(start, contents, tmp_path: Path, which: tuple[str, ...]) -> None:
    """The folder of results, the temporary folder and the kernel cache, alone and together."""
    ends: dict[str, int] = {}
    for name in ("out", "tmp", "cache"):
        (tmp_path / name).mkdir()
    with start(*FRAMES, "--out", "earlier") as run:
        run.communicate()
    earlier = contents(tmp_path / "earlier")
    sizes = SIZES[::3] if "cache" in which else SIZES  # all kernels are compiled each time
    for size in sizes:
        for left in (*tmp_path.glob("*-kept"), *tmp_path.glob("ggwarp-run-*"), tmp_path / "out/run"):
            shutil.rmtree(left, ignore_errors=True)
        words, places = '"$@"', {"TMPDIR": str(tmp_path / "tmp")}
        for name in which:
            kept = tmp_path / f"{name}-kept"
            kept.mkdir()
            words = small(str(tmp_path / name), size, kept).replace('"$@"', words, 1)
        there = (
            "out" in which and "inodes" not in size and 1.3 * sum(map(len, earlier.values())) < _bytes(size)
        )
        if there:
            shutil.copytree(tmp_path / "earlier", tmp_path / "out-kept/run")
        if "cache" in which:
            places["WARP_CACHE_PATH"] = str(tmp_path / "cache")
        with start(*FRAMES, "--out", "out/run", "--checkpoint-every", "1", inside=words, **places) as run:
            out, errors = run.communicate()
        where = f"{size} for {which}: exit {run.returncode}\n{out[-400:]}\n{errors}"
        assert run.returncode in (0, 1, 2) and "Traceback" not in errors, where
        tops = [tmp_path / (f"{name}-kept" if name in which else name) for name in ("out", "tmp")]
        tops += tmp_path.glob("ggwarp-run-*")
        now = contents(tops[0] / "run") if (tops[0] / "run").exists() else {}
        if run.returncode == 0:
            assert len(load_run(tops[0] / "run").poses) == 4, where
        elif there:  # a whole one may have taken its place, and its renders have had no room
            assert now == earlier or len(load_run(tops[0] / "run").poses) == 4, where
        if run.returncode == 2:  # before any work
            assert len([line for line in errors.splitlines() if not line.startswith("warning")]) == 1, where
        else:  # a disk of the machine's own is always among the places
            found = [
                path.parent
                for top in tops
                for path in top.rglob("map.ply")
                if now != earlier or path.parent != tops[0] / "run"
            ]
            assert any(len(read_ply(path / "map.ply")) > 1000 for path in found), where
            assert any(len(read_tum(path / "trajectory.txt")[0]) == 4 for path in found), where
        ends[f"exit {run.returncode}"] = ends.get(f"exit {run.returncode}", 0) + 1
    print(f"{len(sizes)} disks for {' and '.join(which)}: {ends}")


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


def _bytes(size: str) -> int:
    number, unit = size.partition(",")[0][:-1], size.partition(",")[0][-1]
    return int(number) * {"k": 1 << 10, "m": 1 << 20}[unit]
