# SPDX-License-Identifier: Apache-2.0
"""A run replaces another whole, or not at all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ggwarp.results import staging
from ggwarp.results.staging import StagedFolder

RUN = ("config.toml", "camera.json", "map.ply", "trajectory.txt", "metrics.json")


def write_run(folder: Path, text: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in RUN:
        (folder / name).write_text(text)


def texts(folder: Path) -> set[str]:
    return {(folder / name).read_text() for name in RUN if (folder / name).exists()}


def names(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def new_run(out: Path | None, sequence: str = "fr1/xyz") -> StagedFolder:
    folder = StagedFolder(out, sequence)
    folder.create()
    write_run(folder.path, "new")
    return folder


def test_without_a_name_it_is_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    one, two = new_run(None), new_run(None)
    assert not Path("runs/latest").exists(), "it moves last"
    one.publish()
    assert Path("runs/latest").resolve() == one.path.resolve()
    two.publish()
    assert one.path != two.path and one.path.parent == two.path.parent == Path("runs/fr1_xyz")
    assert Path("runs/latest").resolve() == two.path.resolve()
    assert texts(one.path) == texts(two.path) == {"new"} and len(list(Path("runs/fr1_xyz").iterdir())) == 2


@pytest.mark.parametrize("swap", [True, False], ids=["one step", "two steps"])
def test_the_earlier_run_is_there_until_the_new_one_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, swap: bool
) -> None:
    if not swap:
        monkeypatch.setattr(staging.sys, "platform", "other")
    out = tmp_path / "a/o"
    write_run(out, "old")
    (out / "renders").mkdir()
    for name in ("trajectory_gt.txt", "renders/frame000007_rgb.png", "renders/mine.png", "notes.txt"):
        (out / name).write_text("old")
    before = names(out)
    folder = new_run(out)
    assert texts(out) == {"old"} and names(out) == before
    folder.publish()
    assert texts(out) == {"new"} and folder.path == out
    assert names(out) == {*RUN, "renders/mine.png", "notes.txt"}, "a user's own files stay"
    assert [p.name for p in out.parent.iterdir()] == ["o"]


def test_a_run_that_is_given_up_leaves_no_trace(tmp_path: Path) -> None:
    out = tmp_path / "a/b/o"
    new_run(out).discard(whole=True)
    assert list(tmp_path.iterdir()) == []
    write_run(out, "old")
    new_run(out).discard(whole=True)
    assert texts(out) == {"old"} and list(out.parent.iterdir()) == [out]


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years")
    with pytest.raises(FileExistsError, match="holds other files and no run"):
        StagedFolder(tmp_path, "x")
    with pytest.raises(NotADirectoryError):
        StagedFolder(tmp_path / "thesis.tex", "x")
    assert names(tmp_path) == {"thesis.tex"}
    StagedFolder(tmp_path / "empty", "x")


def test_what_is_not_whole_is_kept_apart(tmp_path: Path) -> None:
    write_run(tmp_path / "o", "old")
    for name in ("o-incomplete", "o-incomplete-2"):
        folder = new_run(tmp_path / "o")
        folder.keep_apart()
        assert folder.path == tmp_path / name and texts(folder.path) == {"new"}
    assert texts(tmp_path / "o") == {"old"}


def test_the_current_folder_is_filled_file_by_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path, "old")
    (tmp_path / "frames.csv").write_text("old")
    folder = new_run(Path())
    assert texts(tmp_path) == {"old"} and folder.path.parent == tmp_path
    folder.publish()
    assert names(tmp_path) == set(RUN) and texts(Path()) == {"new"}


def test_a_link_stays_one(tmp_path: Path) -> None:
    write_run(tmp_path / "real", "old")
    (tmp_path / "link").symlink_to("real")
    new_run(tmp_path / "link").publish()
    assert (tmp_path / "link").is_symlink() and texts(tmp_path / "real") == {"new"}


KILLED = """
import sys, time
from pathlib import Path
from ggwarp.results.staging import StagedFolder
folder = StagedFolder(Path("o"), "x")
folder.create()
(folder.path / "config.toml").write_text("half")
print(folder.path, flush=True)
time.sleep(60)
"""


def test_what_a_killed_run_left_is_told_from_what_a_living_one_writes(tmp_path: Path) -> None:
    write_run(tmp_path / "o", "old")
    environment = {**os.environ, "PYTHONPATH": str(Path(staging.__file__).parents[2])}
    with subprocess.Popen(
        [sys.executable, "-c", KILLED], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        left = tmp_path / other.stdout.readline().strip()
        assert left.name.startswith(".o.partial-")
        folder = StagedFolder(tmp_path / "o", "x")
        assert folder.create() == {}
        folder.discard()
        other.send_signal(signal.SIGKILL)
    assert left.is_dir() and texts(tmp_path / "o") == {"old"}
    assert StagedFolder(tmp_path / "o", "x").create() == {left: None}
    assert not left.exists() and texts(tmp_path / "o") == {"old"}


def test_a_swap_that_was_cut_in_two_is_undone(tmp_path: Path) -> None:
    write_run(tmp_path / ".o.old-1", "old")
    (tmp_path / ".o.partial-1").mkdir()
    folder = StagedFolder(tmp_path / "o", "x")
    assert len(folder.create()) == 2
    folder.discard()
    assert texts(tmp_path / "o") == {"old"} and len(list(tmp_path.iterdir())) == 1
