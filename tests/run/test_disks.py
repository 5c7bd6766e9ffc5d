# SPDX-License-Identifier: Apache-2.0
"""Disks that are full or go away: what was computed is kept where there is room."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from pathlib import Path

import pytest

from fake_slam import FRAMES
from ggwarp import run
from ggwarp.console import PlainDisplay
from ggwarp.io import atomic
from ggwarp.io.trajectory import read_tum
from ggwarp.results import run_folder
from ggwarp.results.saved_run import load_run

COMMAND = ["--seq", "room9", "--device", "cpu", "--out", "o"]
FULL = "No space left on device"


@pytest.fixture
def disks(monkeypatch):
    """The names, among a file's and its folders', that nothing can be written under."""
    full: set[str] = set()
    original = open

    def opened(path, mode="r", *arguments, **options):
        parts = {name.removesuffix(".part") for name in Path(path).parts}
        if "w" in mode and any(name in part for name in full for part in parts):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return original(path, mode, *arguments, **options)

    monkeypatch.setattr(atomic, "open", opened, raising=False)
    return full


def files(folder: Path | str) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in Path(folder).iterdir() if p.is_file()}


def in_temporary_folder() -> list[Path]:
    return sorted(Path(tempfile.gettempdir()).iterdir())


def test_a_run_that_has_no_room_is_whole_elsewhere(scene, fake, disks, monkeypatch, capsys):
    assert run.main(COMMAND) == 0
    before = files("o")
    capsys.readouterr()
    disks.update({".o.partial", "config.toml"})
    assert run.main(COMMAND) == 2, "known before the first frame"
    assert f"o/config.toml: {FULL}" in capsys.readouterr().err
    disks.clear()
    monkeypatch.setattr(fake, "on_map", staticmethod(lambda index: disks.add(".o.partial")))
    assert run.main(COMMAND) == 1
    out, errors = capsys.readouterr()
    [kept] = in_temporary_folder()
    assert out.splitlines()[-1] == f"saved in {kept}, as o could not take it"
    assert set(run_folder.OUTPUTS) <= set(files(kept)) and len(load_run(kept).poses) == FRAMES
    metrics = json.loads((kept / "metrics.json").read_text())
    assert metrics["psnr"] is not None, "it is compared all the same"
    assert f"saving the map failed: o/map.ply: {FULL}" in metrics["failures"]
    assert errors.splitlines() == [f"ggwarp: saving the trajectory failed: o/trajectory.txt: {FULL}"]
    assert files("o") == before and {p.name for p in Path().iterdir()} == {"data", "o"}


def test_no_folder_has_room_for_the_map(scene, fake, disks, capsys):
    assert run.main(COMMAND) == 0
    before = files("o")
    disks.add("map.ply")
    assert run.main(COMMAND) == 1
    out, errors = capsys.readouterr()
    assert errors.count("saving the map failed") == 3 and "Traceback" not in errors
    assert "warning: the earlier run in o stays, as this one is not whole" in errors
    assert out.splitlines()[-1] == "3 parts failed; the rest is in o-incomplete"
    assert files("o") == before and in_temporary_folder() == []
    assert len(read_tum(Path("o-incomplete/trajectory.txt"))[0]) == FRAMES
    shutil.rmtree("o")
    shutil.rmtree("o-incomplete")
    assert run.main(COMMAND) == 1
    assert len(read_tum(Path("o/trajectory.txt"))[0]) == FRAMES, "where no earlier run is it takes its place"
    assert len(json.loads(Path("o/metrics.json").read_text())["failures"]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "3 parts failed; the rest is in o"


def test_each_folder_keeps_what_no_other_has(scene, fake, disks, monkeypatch, capsys):
    """The first has room for the trajectory, another for the map."""
    writers = {name: getattr(run_folder, name) for name in ("write_ply_parts", "write_trajectory")}

    def write_ply_parts(path, parts):
        if "temporary" not in str(path):
            raise OSError(errno.ENOSPC, FULL, str(path))
        return writers["write_ply_parts"](path, parts)

    def write_trajectory(folder, reports):
        if "temporary" in str(folder):
            raise OSError(errno.ENOSPC, FULL, str(folder / "trajectory.txt"))
        writers["write_trajectory"](folder, reports)

    monkeypatch.setattr(run_folder, "write_ply_parts", write_ply_parts)
    monkeypatch.setattr(run_folder, "write_trajectory", write_trajectory)
    assert run.main(COMMAND) == 1
    [other] = in_temporary_folder()
    assert (other / "map.ply").is_file() and not (other / "trajectory.txt").exists()
    assert (Path("o") / "trajectory.txt").is_file()
    assert f"warning: what o lacks is in {other}" in capsys.readouterr().err


def test_nothing_fits_anywhere(scene, fake, disks, monkeypatch, capsys):
    everywhere = {"o", "temporary", "ggwarp-"}
    monkeypatch.setattr(fake, "on_map", staticmethod(lambda index: disks.update(everywhere)))
    assert run.main(COMMAND) == 1
    out, errors = capsys.readouterr()
    assert out.splitlines()[-1].endswith("nowhere: no folder could take them") and "Traceback" not in errors
    assert in_temporary_folder() == []


@pytest.mark.parametrize("answers", [[""], ["data", "p"], ["p"]])
def test_on_a_terminal_the_user_is_asked(scene, fake, disks, monkeypatch, capsys, answers):
    asked = []

    def ask(display, question, stopped):
        asked.append(question)
        return answers[len(asked) - 1]

    monkeypatch.setattr(PlainDisplay, "ask", ask)
    monkeypatch.setattr(fake, "on_map", staticmethod(lambda index: disks.add(".o.partial")))
    assert run.main(COMMAND) == 1
    temporary = in_temporary_folder()
    kept = temporary[0] if answers == [""] else Path("p")
    assert len(asked) == len(answers) and asked[0].startswith("o cannot take the run: it is in ")
    assert set(run_folder.OUTPUTS) <= set(files(kept)) and len(temporary) == (answers == [""])
    out, errors = capsys.readouterr()
    assert out.splitlines()[-1] == f"saved in {kept}, as o could not take it"
    assert ("warning: data: holds other files and no run" in errors) == ("data" in answers)


def test_a_folder_that_vanishes(scene, fake, monkeypatch, capsys):
    def vanish(index):
        for path in Path().glob(".o.partial-*"):
            shutil.rmtree(path)

    monkeypatch.setattr(fake, "on_map", staticmethod(vanish))
    assert run.main(COMMAND) == 1
    [kept] = in_temporary_folder()
    assert set(run_folder.OUTPUTS) <= set(files(kept)) and not Path("o").exists()
    assert "Traceback" not in capsys.readouterr().err


def test_a_file_s_need_is_told(tmp_path, monkeypatch):
    def full(file):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(atomic.os, "fsync", full)
    with pytest.raises(OSError, match=rf"{FULL} \(2\.50 MB needed, \d+\.\d\d MB free\)"):
        with atomic.atomic_write(tmp_path / "x") as file:
            file.write(bytes(2_500_000))
    assert list(tmp_path.iterdir()) == []
