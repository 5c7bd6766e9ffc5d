# SPDX-License-Identifier: Apache-2.0
"""Run folders of a stranger: one line and exit code 2, whatever is in them; and names shown as they are."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggwarp.editing.__main__ import main
from ggwarp.io.ply import read_ply, write_ply
from ggwarp.results.saved_run import RunError, load_run

FILES = ("map.ply", "camera.json", "trajectory.txt", "objects.json", "classifier.npz")


def refuse(folder: Path, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return the one line with which ``list`` (or ``words``) fails."""
    assert main([str(folder), *(words or ("list",))]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    return line


HOSTILE = {
    "markup": "[/red]",
    "escape": "\x1b]0;owned\x07",
    "colour": "[bold red]x",
    "lines": "a\nb",
}


@pytest.mark.parametrize("label", HOSTILE.values(), ids=HOSTILE)
def test_a_label_is_shown_and_never_obeyed(run_folder, capsys, label):
    path = run_folder / "objects.json"
    values = json.loads(path.read_text())
    values["objects"][1]["label"] = values["objects"][2]["class"] = label
    values["edits"] = [{"edit": label}]
    path.write_text(json.dumps(values))
    assert main([str(run_folder), "list"]) == 0
    out = capsys.readouterr().out
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in label)
    assert out.count(shown) == 3 and out.replace("\n", "").isprintable()


def test_a_folder_is_shown_and_never_obeyed(run_folder, capsys):
    folder = run_folder.rename(run_folder.parent / "[red]\x1b[31m")
    assert main([str(folder), "list"]) == 0
    assert "\x1b" not in capsys.readouterr().out
    assert "\\x1b" in refuse(folder, capsys, "show", "99")


def test_a_label_given_by_the_user_comes_back(run_folder, capsys):
    assert main([str(run_folder), "label", "5", "[/red] \x1b[31m"]) == 0
    assert main([str(run_folder.parent / "run-edit1"), "list"]) == 0
    assert r"[/red] \x1b[31m" in capsys.readouterr().out


@pytest.mark.parametrize("label", ["\udcff", "x" * 1001])
def test_a_label_that_could_not_be_read_again_is_not_written(run_folder, capsys, label):
    assert "label" in refuse(run_folder, capsys, "label", "5", label)
    assert [path.name for path in run_folder.parent.iterdir()] == ["run"]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("label", 5),
        ("label", "\ud800"),
        ("class", [1]),
        ("count", None),
        ("confidence", "x"),
        ("colour", [1e9, 0, 0]),
        ("box", 3),
    ],
)
def test_values_of_other_types(run_folder, capsys, key, value):
    path = run_folder / "objects.json"
    values = json.loads(path.read_text())
    values["objects"][0][key] = value
    path.write_text(json.dumps(values))
    assert "objects.json: is not as this version writes it" in refuse(run_folder, capsys)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 200_000,
        '{"objects": ' + "[" * 200_000,
        "5",
        "[]",
        "{}",
        '{"objects": 5}',
        '{"objects": {"0": 1}}',
        '{"objects": [5]}',
        '{"objects": [], "edits": [5]}',
        '{"objects": [], "edits": [{"edit": 5}]}',
        '{"objects": [], "edits": 7}',
        '{"objects": [], "edits": [{"edit": "x", "y": ' + "[" * 400 + "]" * 400 + "}]}",
        '{"objects": [' + "9" * 5000 + "]}",
        "\0",
    ],
)
def test_lists_of_objects_that_are_none(run_folder, capsys, text):
    (run_folder / "objects.json").write_text(text)
    assert "objects.json" in refuse(run_folder, capsys)


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_a_device_or_a_pipe(run_folder, capsys, name):
    (run_folder / name).unlink(missing_ok=True)
    (run_folder / name).symlink_to("/dev/zero")
    for _ in range(2):
        main([str(run_folder), "list"])
        err = capsys.readouterr().err
        assert not err or (len(err.splitlines()) == 1 and name in err)
        (run_folder / name).unlink()
        os.mkfifo(run_folder / name)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30])
@pytest.mark.parametrize("field", ["means", "log_scales", "colours", "identities"])
def test_numbers_beyond_all_bounds_in_a_map(run_folder, capsys, field, value):
    gaussians = read_ply(run_folder / "map.ply")
    getattr(gaussians, field)[3, 0] = value
    write_ply(run_folder / "map.ply", gaussians)
    lines = main([str(run_folder), "list"]), capsys.readouterr().err.splitlines()
    if field == "log_scales" and value == -1e30:  # as good as flat
        return
    assert lines[0] == 2 and f"the {field} of 1 of its" in lines[1][0]


def test_infinite_opacities_and_flat_gaussians_are_read(run_folder):
    gaussians = read_ply(run_folder / "map.ply")
    gaussians.opacity_logits[:2] = np.inf, -np.inf
    gaussians.log_scales[0, 0] = -np.inf
    write_ply(run_folder / "map.ply", gaussians)
    again = read_ply(run_folder / "map.ply")
    assert np.isfinite(again.opacity_logits).all() and np.isfinite(again.log_scales).all()


@pytest.mark.parametrize("size", ["1e400", "1e19", "100000", "NaN", "true", "-1", "0.5", '"8"', "9" * 5000])
def test_a_camera_of_no_size(run_folder, capsys, size):
    (run_folder / "camera.json").write_text(
        f'{{"w": {size}, "h": {size}, "fx": 60, "fy": 60, "cx": 59.5, "cy": 33.5, "scale": 1000}}'
    )
    assert "camera.json" in refuse(run_folder, capsys, "show", "5")


@pytest.mark.parametrize(
    "row", ["1 2 3", "nan 0 0 0 0 0 0 1", "0 1e300 0 0 0 0 0 1", "0 0 0 0 0 0 0 1e-300", "\xff"]
)
def test_a_trajectory_of_no_poses(run_folder, capsys, row):
    (run_folder / "trajectory.txt").write_text(row, encoding="latin-1")
    assert "trajectory.txt" in refuse(run_folder, capsys)


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(FILES[:4]),
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=6),
    keep=st.none() | st.floats(0, 1),
)
def test_any_damage_is_a_run_error(run_folder, name, edits, keep):
    path = run_folder / name
    whole = path.read_bytes()
    data = bytearray(whole if keep is None else whole[: int(keep * len(whole))])
    head = min(len(data), 1500)  # where what matters is
    for at, value in edits:
        if data:
            data[int(at * (head - 1))] = value
    try:
        path.write_bytes(data)
        load_run(run_folder)
    except RunError as error:
        assert name in str(error)
    finally:
        path.write_bytes(whole)
