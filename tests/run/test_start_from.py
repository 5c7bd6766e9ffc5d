# SPDX-License-Identifier: Apache-2.0
"""A run that begins in the map of an earlier one: ``--start-from``."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from fake_slam import only_line
from ggwarp import run
from ggwarp.io.json import write_json
from ggwarp.io.ply import read_ply
from ggwarp.io.trajectory import read_tum
from ggwarp.pipeline.loops import localisation
from ggwarp.results.checkpoints import checkpoint_files
from ggwarp.results.run_folder import OUTPUTS
from ggwarp.results.saved_run import load_run
from office_runs import contents_of

OPTIONS = ["--seq", "office", "--preset", "fast", "--device", "cpu", "--scale", "0.15", "--save-renders", "0"]
NEW = ["--frames", "20:26"]


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the first ten frames; its world is the truth's."""
    out = tmp_path_factory.mktemp("earlier") / "first"
    assert run.main([*OPTIONS, "--frames", "0:10", "--out", str(out), "-q"]) == 0
    return out


@pytest.fixture(scope="module")
def begun(earlier: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of later frames that begins in its map."""
    out = tmp_path_factory.mktemp("begun") / "second"
    options = ["--start-from", str(earlier), "--checkpoint-every", "3", "--out", str(out), "-q"]
    assert run.main([*OPTIONS, *NEW, *options]) == 0
    return out


def ids(folder: Path) -> set[int]:
    return {record.id for record in load_run(folder).objects}


def errors(folder: Path) -> np.ndarray:
    """Return how far positions are from the true ones, in the run's own world, metres."""
    (_, estimated), (_, true) = (read_tum(folder / f"trajectory{end}.txt") for end in ("", "_gt"))
    return np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)


def test_it_goes_on_in_the_world_and_with_the_objects_of_the_earlier_run(earlier: Path, begun: Path) -> None:
    assert errors(begun).max() < 0.001 and len(errors(begun)) == 6
    old, new = read_ply(earlier / "map.ply"), read_ply(begun / "map.ply")
    assert len(new) > len(old)
    assert new.means[:, 0].max() > old.means[:, 0].max() - 0.01, "what is not seen again is still there"
    assert {record.id for record in load_run(earlier).objects if record.count > 20} <= ids(begun)
    metrics = json.loads((begun / "metrics.json").read_text())
    assert metrics["frames_lost"] == 0 and metrics["plan"]["start_from"] == str(earlier)
    assert metrics["miou_matched"] > 0.7 and metrics["psnr"] > 20.0


def test_the_masks_of_the_same_objects_are_found_to_be_the_old_ones(earlier: Path, begun: Path) -> None:
    """The office's masks mean the same in both runs, which the second run does not know."""
    old = {record.id: record for record in load_run(earlier).objects}
    new = {record.id: record for record in load_run(begun).objects}
    large = [i for i, record in old.items() if record.count > 100 and new[i].views]
    assert len(large) > 5
    for identifier in large:
        assert identifier in new[identifier].source_ids


def test_the_earlier_run_stays_as_it_is_and_where_it_was_found_is_said(
    earlier: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    before = contents_of(earlier)
    shutil.copytree(earlier, "a")
    write_json(Path("a/objects.json"), labelled(earlier))
    assert (
        run.main([*OPTIONS, "--frames", "20:22", "--start-from", "a", "--out", "b", "--masks", "none"]) == 0
    )
    said = "".join(capsys.readouterr())
    assert "frame 20 found in a: near frame " in said and "of its points on the map" in said
    assert "beginning in the map of a:" in said
    assert contents_of(earlier) == before
    assert load_run("b").find("my wall").id == 1 and ids(Path("b")) == ids(earlier), "without masks, too"


def labelled(folder: Path) -> dict:
    values = json.loads((folder / "objects.json").read_text())
    for entry in values["objects"]:
        entry["label"] = "my wall" if entry["id"] == 1 else None
    return values


def test_another_room_ends_the_run_and_leaves_nothing(
    earlier: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["--seq", "wall", "--start-from", str(earlier), "--out", "b", "-q"]
    before = contents_of(earlier)
    assert run.main([*OPTIONS, *options, "--frames", "0:3"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert "none of 3 frames was found in this run's map, and nothing is saved" in lines[-1]
    assert all("lost: not yet found in" in line for line in lines[:-1]) and len(lines) == 4
    monkeypatch.setattr(localisation, "_PATIENCE", 2)
    assert run.main([*OPTIONS, *options, "--frames", "0:30"]) == 1
    assert "none of 2 frames was found" in capsys.readouterr().err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == [] and contents_of(earlier) == before


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ("--start-from nowhere", "--start-from nowhere: no such folder; give a run folder"),
        ("--start-from a --out a", "--out is the same run, which is never changed"),
        ("--start-from a --mono", "--start-from a: the camera is found by depth and colour"),
        ("--start-from a --tracker ground-truth", "ground-truth has a world of its own"),
        ("--start-from mono", "its map is of colour alone and has no scale"),
        ("--start-from empty", "--start-from empty: its map is empty"),
        ("--start-from away", "--start-from away: its map shows nothing from where its camera was"),
        ("--start-from torn", "--start-from torn: has no map.ply"),
    ],
)
def test_what_cannot_be_started_from_is_refused(
    earlier: Path, tmp_path: Path, monkeypatch, capsys, options: str, reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "mono", "empty", "away", "torn"):
        shutil.copytree(earlier, name, ignore=shutil.ignore_patterns("checkpoints", "pictures"))
    config = Path("mono/config.toml").read_text()
    Path("mono/config.toml").write_text(config.replace("\nmono = false", "\nmono = true"))
    Path("empty/trajectory.txt").write_text("")
    Path("away/trajectory.txt").write_text("0 50 50 50 0 0 0 1\n")
    Path("torn/map.ply").unlink()
    before = contents_of(tmp_path)
    assert run.main([*OPTIONS, *NEW, "-q", *options.split()]) == run.USER_ERROR
    assert reason in only_line(capsys)
    assert contents_of(tmp_path) == before


def test_such_a_run_can_be_resumed(earlier: Path, begun: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(begun, "b")
    newest, _ = checkpoint_files(Path("b"))
    newest.unlink()
    assert run.main(["--resume", "b", "--out", "c", "-q"]) == 0
    for name in {*OUTPUTS} - {"metrics.json", "frames.csv", "report.html"}:
        assert Path("c", name).read_bytes() == (begun / name).read_bytes(), name
    moved = Path(shutil.copytree(earlier, "moved"))
    assert run.main(["--resume", "b", "--start-from", "moved", "--out", "d", "-q"]) == 0
    (moved / "map.ply").write_bytes((begun / "map.ply").read_bytes())
    capsys.readouterr()
    assert run.main(["--resume", "b", "--start-from", "moved", "-q"]) == run.USER_ERROR
    assert "its map is not the one that the run to go on with began in" in only_line(capsys)
    shutil.copytree(earlier, "e")
    assert run.main(["--resume", "e", "--start-from", "moved", "-q"]) == run.USER_ERROR
    assert "a run keeps what it began with, an empty map" in only_line(capsys)
