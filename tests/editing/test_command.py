# SPDX-License-Identifier: Apache-2.0
"""``ggwarp objects``: what it says, leaves and returns."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp.editing.__main__ import main
from ggwarp.io.ply import read_ply, write_ply
from ggwarp.results.saved_run import RunError, load_run


def _bytes(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_list(run_folder, capsys):
    assert main([str(run_folder), "list"]) == 0
    out = capsys.readouterr().out
    assert "3 objects" in out and out.count("cube") == 2 and "0.40 x 0.40 x 0.40" in out


def test_show_lights_the_object(run_folder, capsys):
    assert main([str(run_folder), "show", "5", "--views", "2", "--device", "cpu"]) == 0
    files = capsys.readouterr().out.split()
    assert files == [str(run_folder / "objects" / "5-cube" / f"view{k}.png") for k in (1, 2)]
    picture = cv2.imread(files[0])
    assert picture is not None and picture.shape == (64, 96, 3)
    colourful = np.ptp(picture.astype(int), axis=2) > 100
    assert 150 < colourful.sum() < 2000  # the cube alone has its colour
    assert picture[~colourful].mean() < 80


def test_an_object_moved_with_its_hole_filled_leaves_no_crumbs(run_folder):
    gaussians = read_ply(run_folder / "map.ply")
    assert gaussians.object_ids is not None
    stray = np.nonzero(np.linalg.norm(gaussians.means - [1.2, 1.2, 3.0], axis=1).argsort().argsort() < 2)[0]
    gaussians.object_ids[stray] = 5
    write_ply(run_folder / "map.ply", gaussians)
    out = run_folder / "moved"
    where = ["--translate", "0.2", "-0.6", "0", "--no-adopt", "--fill", "--device", "cpu"]
    assert main([str(run_folder), "move", "5", *where, "--out", str(out)]) == 0
    moved = read_ply(out / "map.ply")
    own = moved.means[moved.object_ids == 5]
    assert len(own) == 6 * 81 and np.abs(own.mean(0) - [-0.1, -0.6, 2.0]).max() < 0.01


def test_extract(run_folder, capsys):
    assert main([str(run_folder), "extract", "5", "--views", "1", "--out", str(run_folder / "x")]) == 0
    alone = read_ply(run_folder / "x" / "object.ply")
    assert alone.object_ids is not None and set(alone.object_ids.tolist()) == {5} and len(alone) == 6 * 81
    picture = cv2.imread(str(run_folder / "x" / "alone1.png"), cv2.IMREAD_UNCHANGED)
    assert picture is not None and picture.shape[2] == 4
    seen = picture[..., 3] > 200
    assert 0.2 < seen.mean() < 0.9 and picture[seen][:, 2].mean() > 200  # red, on nothing


def test_edits_make_a_new_run(run_folder, capsys):
    before = _bytes(run_folder)
    words = "remove 8 then move 5 --translate 0 0.1 -0.2 --rotate 0 0 90 then label 5 box"
    words += " then recolor wall 9 9 200"
    assert main([str(run_folder), *words.split()]) == 0
    assert _bytes(run_folder) == before
    new = load_run(run_folder.with_name("run-edit1"))
    assert str(new.folder) in capsys.readouterr().out
    assert [(o.id, o.name) for o in new.objects] == [(1, "wall"), (5, "box")]
    assert [e["edit"] for e in new.edits] == ["remove", "move", "label", "recolor"]
    np.testing.assert_allclose(new.objects[1].centre, [-0.3, 0.1, 1.8], atol=1e-4)
    assert new.objects[0].colour[2] > 150 > new.objects[0].colour[0]
    values = json.loads((new.folder / "objects.json").read_text())
    assert values["edited_from"] == str(run_folder.resolve())
    assert (new.folder / "config.toml").read_text() == 'seq = "x"\n'
    # Edits go on from there.
    assert main([str(new.folder), "remove", "box"]) == 0
    last = load_run(run_folder.with_name("run-edit2"))
    assert [o.id for o in last.objects] == [1] and len(last.edits) == 5


def test_move_and_move_back(run_folder):
    one, two = run_folder.with_name("one"), run_folder.with_name("two")
    there = "move 5 --translate 0.3 -0.2 0.1 --axis 1 2 3 --angle 40".split()
    back = "move 5 --translate -0.3 0.2 -0.1 --axis 1 2 3 --angle -40".split()
    assert main([str(run_folder), *there, "--out", str(one)]) == 0
    assert main([str(one), *back, "--out", str(two)]) == 0
    a, b, c = (load_run(f).gaussians for f in (run_folder, one, two))
    assert np.abs(a.means - b.means).max() > 0.2
    for name, before in a.arrays().items():
        np.testing.assert_allclose(getattr(c, name), before, rtol=0, atol=1e-6, err_msg=name)


def test_a_link_to_the_latest_run_is_followed(run_folder, tmp_path):
    (tmp_path / "latest").symlink_to("run", target_is_directory=True)
    assert main([str(tmp_path / "latest"), "label", "5", "box"]) == 0
    assert (tmp_path / "run-edit1").is_dir()


def test_a_word_of_its_name_means_an_object(run_folder):
    assert main([str(run_folder), "label", "5", "office chair"]) == 0
    run = load_run(run_folder.with_name("run-edit1"))
    assert run.find("chair").id == run.find("Office CHAIR").id == 5
    with pytest.raises(RunError, match=r"air: .* no such object"):
        run.find("air")


def test_merge_and_split(run_folder, capsys):
    assert main([str(run_folder), "merge", "5", "8"]) == 0
    merged = load_run(run_folder.with_name("run-edit1"))
    assert [(o.id, o.source_ids, o.count) for o in merged.objects][1:] == [(5, (5, 8), 2 * 6 * 81)]
    assert main([str(merged.folder), "split", "cube"]) == 0
    again = load_run(run_folder.with_name("run-edit2"))
    assert [(o.id, o.name, o.count) for o in again.objects][1:] == [(5, "cube", 486), (9, "cube 2", 486)]
    assert again.edits == ({"edit": "merge", "ids": [5, 8]}, {"edit": "split", "id": 5, "new": [9]})
    assert "before_after" not in capsys.readouterr().out  # nothing looks different


def test_a_picture_of_before_and_after(run_folder, capsys):
    assert main([str(run_folder), "recolor", "5", "9", "9", "200", "--device", "cpu"]) == 0
    path = Path(capsys.readouterr().out.split()[-1])
    picture = cv2.imread(str(path))
    assert path.name == "before_after.png" and picture is not None
    before, after = picture[:, : picture.shape[1] // 2 - 4], picture[:, picture.shape[1] // 2 + 4 :]
    red, blue = (
        (p.argmax(axis=2) == k) & (np.ptp(p.astype(int), axis=2) > 100) for p, k in ((before, 2), (after, 0))
    )
    assert red.sum() > 1000 and 0.8 < blue.sum() / red.sum() < 1.2
    assert main([str(run_folder), "recolor", "5", "9", "9", "200", "--no-picture"]) == 0
    assert not (run_folder.with_name("run-edit2") / "before_after.png").exists()


MISTAKES = [
    ("", "required: RUN, VERB"),
    ("absent list", "absent: no such folder"),
    (". list", "no map.ply"),
    ("run", "VERB"),
    ("run dance", "invalid choice: 'dance'"),
    ("run show 99", "99: run has no such object"),
    ("run show cube", "cube: 2 objects have this name; give one of the ids 5 (cube), 8 (cube)"),
    ("run show 5 --views 0", "--views 0"),
    ("run show 5 --device cuda:77", "--device cuda:77: no such device"),
    ("run remove 5 --probability 0.3", "classifier"),
    ("run remove 5 --probability 2", "--probability 2: give a number"),
    ("run remove 1 5 8", "nothing would be left"),
    ("run move 5", "where to?"),
    ("run move 5 --axis 0 0 0 --angle 3", "--axis 0 0 0"),
    ("run move 5 --angle 3", "--axis and --angle go together"),
    ("run move 5 --translate 0 nan 0", "--translate"),
    ("run recolor 5 1 2 300", "0 to 255"),
    ("run recolor 5 1 2", "required: B"),
    ("run list then remove 5", "only edits are joined"),
    ("run remove 5 then remove 5", "5: run has no such object"),
    ("run remove 5 --out run", "run: exists already"),
    ("run remove wal", "wal: run has no such object (did you mean wall?)"),
    ("run merge 5 5", "merge 5 5: give two objects or more"),
    ("run split 5", "cube: is in one piece; --parts N cuts it into N"),
    ("run split 5 --parts 1", "--parts 1: 486 Gaussians make no 1 parts"),
]


@pytest.mark.parametrize(("words", "message"), MISTAKES, ids=[w or "nothing" for w, _ in MISTAKES])
def test_a_mistake_ends_in_one_line(run_folder, monkeypatch, capsys, words, message):
    monkeypatch.chdir(run_folder.parent)
    assert main(words.split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("ggwarp objects: ") and message in lines[0], lines
    assert [p.name for p in run_folder.parent.iterdir()] == ["run"]


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("map.ply", "ply\n", "malformed"),
        ("camera.json", "{}", "is no camera"),
        ("objects.json", '{"objects": [{"id": 1}]}', "not as this version writes it"),
        ("objects.json", "[", "not as this version writes it"),
        ("trajectory.txt", "1 2\n", "is no pose"),
        ("classifier.npz", "x", "is no identity classifier"),
    ],
)
def test_a_damaged_folder_ends_in_one_line(run_folder, capsys, file, text, message):
    (run_folder / file).write_text(text)
    assert main([str(run_folder), "list"]) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1 and file in err and message in err


def test_a_map_without_objects_cannot_be_edited(run_folder, capsys):
    gaussians = read_ply(run_folder / "map.ply")
    write_ply(run_folder / "map.ply", dataclasses.replace(gaussians, object_ids=None))
    assert main([str(run_folder), "list"]) == 2
    assert "its map knows no objects; run the sequence with masks" in capsys.readouterr().err


def test_pictures_are_not_overwritten(run_folder, capsys):
    assert main([str(run_folder), "show", "5", "--views", "1"]) == 0
    before = _bytes(run_folder)
    assert main([str(run_folder), "show", "5", "--views", "1"]) == 2
    assert "view1.png: exists already" in capsys.readouterr().err and _bytes(run_folder) == before


def test_a_hidden_object_cannot_be_shown(run_folder, capsys):
    poses = (run_folder / "trajectory.txt").read_text().splitlines()
    (run_folder / "trajectory.txt").write_text(poses[-1] + "\n")  # the one that looks away
    assert main([str(run_folder), "show", "5"]) == 2
    assert "out of sight" in capsys.readouterr().err


def test_as_a_program(run_folder):
    done = subprocess.run(
        [sys.executable, "-m", "ggwarp.editing", str(run_folder), "show", "99"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and done.stdout == ""
