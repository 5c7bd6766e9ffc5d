# SPDX-License-Identifier: Apache-2.0
"""``ggwarp view``: what it refuses, and what it reads of a run beside the map."""

from __future__ import annotations

import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.io.trajectory import write_tum
from ggwarp.results.saved_run import load_run
from ggwarp.viewer.__main__ import main
from ggwarp.viewer.history import RecordedPictures, read_history
from ggwarp.viewer.panels.tools import between
from ggwarp.viewer.thumbnails import HEIGHT, WIDTH, thumbnails


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("absent", "absent: no such folder"),
        ("run --at 1:2:3", "--at 1:2:3: give HOST:PORT"),
        ("run --up sideways", "--up 'sideways': give auto, x,"),
        ("run --device cuda:77", "--device cuda:77: no such device"),
        ("run --save absent/scene.html", "No such file or directory"),
    ],
)
def test_a_mistake_ends_in_one_line(run_folder, monkeypatch, capsys, words, message):
    monkeypatch.chdir(run_folder.parent)
    assert main(words.split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("ggwarp view: ") and message in lines[0], lines


def _write_course(run_folder, rows: list[str]) -> None:
    (run_folder / "frames.csv").write_text("\n".join(["index,keyframe,loop_with", *rows, ""]))


def test_the_course_of_a_run(run_folder):
    _write_course(run_folder, ["10,tracking,", "12,,", "14,mapping,", "16,,10", "18,,99"])
    write_tum(run_folder / "trajectory_live.txt", np.arange(5), list(load_run(run_folder).poses))
    history = read_history(load_run(run_folder))
    assert history.indices == [10, 12, 14, 16, 18]
    assert history.keyframes == [0, 2] and history.loops == [(3, 0)] and history.live.shape == (5, 4, 4)


@pytest.mark.parametrize("rows", [None, ["1,,", "2,,"], ["x,,"] * 5, ["1"]])
def test_a_run_without_a_course_is_shown_all_the_same(run_folder, rows):
    if rows is not None:
        _write_course(run_folder, rows)
    history = read_history(load_run(run_folder))
    assert history.indices == [0, 1, 2, 3, 4] and not history.keyframes and not history.loops


def test_pictures_of_the_recording_while_it_is_there(run_folder):
    assert RecordedPictures(run_folder).picture(0) is None
    (run_folder / "config.toml").write_text('seq = "office"\nscale = 0.1\n')
    pictures = RecordedPictures(run_folder)
    picture = pictures.picture(3)
    assert picture is not None and picture.shape == (68, 120, 3) and picture.std() > 10.0
    assert pictures.picture(10_000) is None


def test_a_thumbnail_shows_its_object(run_folder):
    pictures = dict(found for found in thumbnails(load_run(run_folder)) if found is not None)
    assert set(pictures) == {1, 5, 8}
    for identifier, channel in ((5, 0), (8, 1)):
        picture = pictures[identifier]
        assert picture.shape == (HEIGHT, WIDTH, 3) and picture.dtype == np.uint8
        middle = picture[HEIGHT // 2 - 8 : HEIGHT // 2 + 8, WIDTH // 2 - 8 : WIDTH // 2 + 8].mean((0, 1))
        assert middle.argmax() == channel and middle[channel] > 150.0


def test_a_path_goes_through_its_views(rng):
    views = [se3.se3_exp(rng.normal(size=6)) for _ in range(3)]
    path = between(views, 10)
    assert len(path) == 21
    for k, T_wc in enumerate(views):
        np.testing.assert_allclose(path[10 * k], T_wc, atol=1e-9)
    for first, (one, other) in ((0, views[:2]), (10, views[1:])):
        way = np.linalg.norm(other[:3, 3] - one[:3, 3])
        steps = np.linalg.norm(np.diff([T[:3, 3] for T in path[first : first + 11]], axis=0), axis=1)
        assert steps.max() < 0.16 * way and np.isclose(steps.sum(), way)
    for T_wc in path:
        np.testing.assert_allclose(T_wc[:3, :3] @ T_wc[:3, :3].T, np.eye(3), atol=1e-9)


def test_a_thumbnail_has_its_object_in_the_middle_and_large(run_folder):
    pictures = dict(found for found in thumbnails(load_run(run_folder)) if found is not None)
    red = pictures[5][HEIGHT // 2, :, 0].astype(int)
    inside = np.nonzero(red > 0.75 * red.max())[0]
    assert WIDTH // 4 < np.ptp(inside) < WIDTH
    assert abs(inside.mean() - 0.5 * WIDTH) < 0.15 * WIDTH
