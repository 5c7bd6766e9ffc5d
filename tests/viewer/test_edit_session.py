# SPDX-License-Identifier: Apache-2.0
"""What a user of the page can do, without the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggwarp.editing.__main__ import main as objects_command
from ggwarp.geometry import se3
from ggwarp.results.saved_run import RunError, load_run
from ggwarp.viewer import edit_session
from ggwarp.viewer.edit_session import EditSession

RED, GREEN, WALL = 5, 8, 1
AHEAD = [0.0, 0.0, 1.0]


@pytest.fixture
def session(run_folder: Path) -> EditSession:
    return EditSession(load_run(run_folder))


def _ids(session: EditSession) -> list[int]:
    return [record.id for record in session.run.objects]


def _towards(session: EditSession, identifier: int) -> np.ndarray:
    return np.array(session.record(identifier).centre) - [0.0, 0.0, 0.0]


def test_what_is_pointed_at_is_picked(session):
    eye = np.zeros(3)
    for identifier in (RED, GREEN):
        pick = session.pick(eye, _towards(session, identifier))
        assert pick is not None and pick.object_id == identifier
    wall = session.pick(eye, [0.0, 0.3, 1.0])
    assert wall is not None and wall.object_id == WALL
    np.testing.assert_allclose(wall.point, [0.0, 0.9, 3.0], atol=0.03)
    assert session.pick(eye, [0.0, 0.0, -1.0]) is None


def test_what_is_hidden_is_looked_through(session):
    session.hide(RED)
    assert session.pick(np.zeros(3), _towards(session, RED)).object_id == WALL
    session.isolate(GREEN)
    assert session.hidden == {RED, WALL}
    assert session.pick(np.zeros(3), _towards(session, RED)) is None
    session.show_all()
    assert session.pick(np.zeros(3), _towards(session, RED)).object_id == RED


def test_selecting(session):
    session.select(RED)
    session.select(GREEN, add=True)
    assert session.selected == (RED, GREEN)
    session.select(RED, add=True)
    assert session.selected == (GREEN,)
    session.select()
    assert session.selected == ()


def test_undo_and_redo_give_the_same_maps(session):
    maps = [session.run.gaussians]
    session.select(RED)
    for edit in (
        lambda: session.paint([0, 0, 255]),
        lambda: session.name("box"),
        lambda: session.remove(fill=False),
    ):
        edit()
        maps.append(session.run.gaussians)
    assert _ids(session) == [WALL, GREEN] and session.selected == ()
    assert session.commands == ["recolor 5 0 0 255", "label 5 box", "remove 5 --no-fill"]
    for before in maps[-2::-1]:
        session.undo()
        assert session.run.gaussians is before
    with pytest.raises(RunError, match="undo: nothing was edited"):
        session.undo()
    for after in maps[1:]:
        session.redo()
        assert session.run.gaussians is after
    with pytest.raises(RunError, match="redo: nothing was undone"):
        session.redo()


def test_an_edit_after_undo_forgets_what_was_undone(session):
    session.select(RED)
    session.paint([0, 0, 255])
    session.undo()
    session.name("box")
    assert session.redoable == "" and session.commands == ["label 5 box"]


def test_a_refused_edit_changes_nothing(session):
    session.select(RED, GREEN)
    before = session.run
    for refused in (lambda: session.name("two"), lambda: session.paint([0, 0, 300]), lambda: session.split()):
        with pytest.raises(RunError):
            refused()
    session.select()
    with pytest.raises(RunError, match="0 objects are selected; select an object"):
        session.remove()
    assert session.run is before and session.commands == []


def test_a_motion_is_about_the_grip(session):
    grip, chosen = session.grip(RED)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = se3.so3_exp([0.0, 0.0, np.pi / 2]), [0.1, -0.2, 0.3]
    before = session.run.gaussians.means.astype(np.float64)
    session.select(RED)
    session.move(T)
    expected = (before[chosen] - grip) @ T[:3, :3].T + grip + T[:3, 3]
    np.testing.assert_allclose(session.run.gaussians.means[chosen], expected, atol=1e-5)
    np.testing.assert_array_equal(session.run.gaussians.means[~chosen], before.astype(np.float32)[~chosen])


def test_the_commands_do_the_same_in_the_shell(session, run_folder):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = se3.so3_exp([0.3, -0.2, 1.0]), [0.1, -0.2, 0.0]
    session.select(RED)
    session.move(T)
    session.name("Anna's box")
    session.select(GREEN)
    session.paint([1, 2, 250])
    saved = load_run(session.save())
    import shlex

    words = shlex.split(" then ".join(session.commands))
    assert (
        objects_command([str(run_folder), *words, "--out", str(run_folder) + "-shell", "--no-picture"]) == 0
    )
    shell = load_run(str(run_folder) + "-shell")
    assert shell.objects == saved.objects and shell.edits == saved.edits
    for name, values in saved.gaussians.arrays().items():
        np.testing.assert_array_equal(values, getattr(shell.gaussians, name))


@pytest.mark.parametrize("name", ["then", "-x", "--help", "a b", ""])
def test_any_name_can_be_given(session, name):
    session.select(RED)
    session.name(name)
    assert session.record(RED).label == (name or None)


def test_saving_makes_a_new_run_and_never_touches_the_old(session, run_folder):
    before = {p.name: p.read_bytes() for p in run_folder.iterdir()}
    session.select(RED)
    session.paint([0, 0, 255])
    assert not session.is_saved
    first = session.save()
    assert first.name == "run-edit1" and session.is_saved
    session.merge() if len(session.selected) > 1 else session.name("x")
    assert not session.is_saved and session.save().name == "run-edit2"
    session.undo()
    assert not session.is_saved
    assert {p.name: p.read_bytes() for p in run_folder.iterdir()} == before


def test_merge_and_split(session):
    session.select(GREEN, RED)
    session.merge()
    assert _ids(session) == [WALL, GREEN] and session.selected == (GREEN,)
    session.split()
    assert _ids(session) == [WALL, GREEN, 9]


def test_old_versions_are_dropped(session, monkeypatch):
    monkeypatch.setattr(edit_session, "MOST_VERSIONS", 2)
    session.select(RED)
    for k in range(4):
        session.name(f"name {k}")
    assert session.commands == ["label 5 'name 2'", "label 5 'name 3'"]
    session.undo()
    session.undo()
    assert session.record(RED).name == "name 1" and session.undoable == ""


def test_progress_of_a_removal(session):
    told: list[tuple[str, float]] = []
    session.select(RED)
    session.remove(progress=lambda what, share: told.append((what, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares) and 0.0 <= shares[0] and shares[-1] <= 1.0
    assert {"finding what it hid", "fitting"} <= {what for what, _ in told}
    assert RED not in _ids(session)
