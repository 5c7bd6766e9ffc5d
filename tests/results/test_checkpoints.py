# SPDX-License-Identifier: Apache-2.0
"""Which checkpoints a run keeps, and which run a name means to go on with."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from ggwarp.io.guarded import FileError
from ggwarp.io.lock import lock_folder
from ggwarp.results.checkpoints import checkpoint_files, find_run, save_checkpoint
from ggwarp.results.staging import StagedFolder

START = 1_700_000_000


def run_in(folder: Path, started: int, *values: int) -> Path:
    """Make a run's folder that began at ``started``, with a checkpoint for each value."""
    folder.mkdir(parents=True)
    for name in ("config.toml", "camera.json", "map.ply", "trajectory.txt"):
        (folder / name).write_text(str(started))
    os.utime(folder / "config.toml", (START + started, START + started))
    for value in values:
        save_checkpoint(folder, {"value": value})
    return folder


def value_of(run: Path) -> tuple[Any, Path]:
    found = find_run(run)
    return found.load()[0]["value"], found.target


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_the_last_two_stay(tmp_path: Path) -> None:
    run = run_in(tmp_path / "o", 1, 10, 11, 12)
    (run / "checkpoints/.000004.safetensors.77.part").write_text("killed while it was written")
    assert [p.name for p in checkpoint_files(run)] == ["000003.safetensors", "000002.safetensors"]
    save_checkpoint(run, {"value": 13})
    assert names(run / "checkpoints") == ["000003.safetensors", "000004.safetensors"]
    assert value_of(run) == (13, run)


def test_a_damaged_one_gives_way_to_the_one_before(tmp_path: Path) -> None:
    run = run_in(tmp_path / "o", 1, 10, 11)
    newest, before = checkpoint_files(run)
    newest.write_bytes(newest.read_bytes()[:-1])
    tree, faults = find_run(run).load()
    assert tree["value"] == 10 and len(faults) == 1 and "000002.safetensors: is damaged" in faults[0]
    before.write_bytes(b"")
    with pytest.raises(
        FileError, match=r"000002\.safetensors: is damaged.*; .*000001\.safetensors: is damaged"
    ):
        find_run(run).load()


def test_what_a_killed_run_left_goes_first_unless_another_took_its_place(tmp_path: Path) -> None:
    out = run_in(tmp_path / "o", 5, 1)
    left = run_in(tmp_path / ".o.partial-999999", 7, 2)
    assert value_of(out) == (2, out) and value_of(left) == (2, out)
    run_in(tmp_path / ".o.partial-999998", 9)  # killed before its first checkpoint
    assert value_of(out) == (2, out)
    os.utime(out / "config.toml", (START + 8, START + 8))  # a later run is done: this is what it replaced
    assert value_of(out) == (1, out)


@pytest.mark.parametrize(
    ("name", "target"),
    [
        (".o.partial-999999", "o"),
        (".o.partial-999999-2", "o"),
        ("o-incomplete", "o"),
        ("o-incomplete-3", "o"),
        ("o/.partial-999999", "o"),
        ("o/incomplete-2", "o"),
        ("o", "o"),
        ("o-completed", "o-completed"),
    ],
)
def test_where_a_run_belongs(tmp_path: Path, name: str, target: str) -> None:
    assert value_of(run_in(tmp_path / name, 1, 4)) == (4, tmp_path / target)
    if name.startswith((".", "o/.")):
        assert value_of(tmp_path / "o") == (4, tmp_path / "o"), "by the name that it was to have"


def test_a_link_shows_the_run(tmp_path: Path) -> None:
    run = run_in(tmp_path / "office/now", 1, 4)
    (tmp_path / "latest").symlink_to(run)
    assert value_of(tmp_path / "latest")[0] == 4


def test_what_cannot_go_on_is_told(tmp_path: Path) -> None:
    run_in(tmp_path / "bare", 1)
    for name, reason in (
        ("none", "no such run; start"),
        ("bare", "bare: has no checkpoint; start the run anew"),
    ):
        with pytest.raises(FileError, match=reason):
            find_run(tmp_path / name)
    run_in(tmp_path / "bare-incomplete", 1, 3)
    with pytest.raises(FileError, match=r"has no checkpoint; .*bare-incomplete has some"):
        find_run(tmp_path / "bare")


def test_a_run_that_is_going_on_is_left_alone(tmp_path: Path) -> None:
    out, left = run_in(tmp_path / "o", 1, 1), run_in(tmp_path / ".o.partial-999999", 2, 2)
    lock = lock_folder(left)
    assert lock is not None
    for name in (out, left):
        with pytest.raises(FileError, match="still going on; stop it first"):
            find_run(name)
    os.close(lock)
    assert value_of(out)[0] == 2


def test_a_new_run_keeps_what_can_go_on_or_has_a_map(tmp_path: Path) -> None:
    out = run_in(tmp_path / "o", 5)
    left, bare = run_in(tmp_path / ".o.partial-999999", 7, 2), run_in(tmp_path / ".o.partial-999998", 8)
    (bare / "map.ply").unlink()
    live = run_in(tmp_path / "p", 8).rename(tmp_path / ".p.partial-999998")
    assert StagedFolder(tmp_path / "p", "x").create() == {live: tmp_path / "p-incomplete"}
    assert names(tmp_path / "p-incomplete") == ["camera.json", "config.toml", "map.ply", "trajectory.txt"]
    shutil.rmtree(tmp_path / "p-incomplete")
    shutil.rmtree(next(tmp_path.glob(".p.*")))
    replaced = run_in(tmp_path / ".o.partial-999997", 3, 1)
    folder = StagedFolder(out, "x")
    kept = tmp_path / "o-incomplete"
    assert folder.create() == {left: kept, bare: None, replaced: None}
    assert value_of(kept) == (2, out)
    folder.discard()
    assert names(tmp_path) == ["o", "o-incomplete"]


def test_a_run_goes_on_in_the_folder_that_was_left(tmp_path: Path) -> None:
    out = run_in(tmp_path / "o", 5)
    left = run_in(tmp_path / ".o.partial-999999", 7, 2)
    folder = StagedFolder(out, "x", adopted=left)
    assert names(tmp_path) == [".o.partial-999999", "o"], "nothing is changed yet"
    assert folder.create() == {}
    assert folder.path == tmp_path / f".o.partial-{os.getpid()}" and not left.exists()
    with pytest.raises(FileError, match="still going on"):
        find_run(out)
    folder.publish()
    assert names(tmp_path) == ["o"] and (out / "map.ply").read_text() == "7" and value_of(out) == (2, out)


def test_a_run_that_fails_leaves_its_checkpoints(tmp_path: Path) -> None:
    folder = StagedFolder(tmp_path / "o", "x")
    folder.create()
    save_checkpoint(folder.path, {"value": 3})
    assert folder.discard() == tmp_path / "o-incomplete"
    assert value_of(tmp_path / "o-incomplete") == (3, tmp_path / "o")


def test_replaced_checkpoints_are_no_files_of_the_user(tmp_path: Path) -> None:
    out = run_in(tmp_path / "o", 5, 1, 2)
    (out / "checkpoints/mine.txt").write_text("x")
    folder = StagedFolder(out, "x")
    folder.create()
    run_in(folder.path / "new", 6, 3)
    for path in (folder.path / "new").iterdir():
        path.rename(folder.path / path.name)
    (folder.path / "new").rmdir()
    folder.publish()
    assert names(out / "checkpoints") == ["000001.safetensors", "mine.txt"] and value_of(out)[0] == 3
