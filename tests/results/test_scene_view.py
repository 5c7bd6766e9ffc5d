# SPDX-License-Identifier: Apache-2.0
"""How a map is shown: upright, from a pose that sees much; as a file, and as a user says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ggwarp.geometry.camera import Camera
from ggwarp.geometry.upright import Up
from ggwarp.io.guarded import FileError
from ggwarp.map.gaussians import Gaussians
from ggwarp.results.scene_view import SceneView, describe_view, parse_up, read_view, write_view

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


def floor(rng: np.random.Generator) -> Gaussians:
    """Flat Gaussians at y = 1.5, below cameras whose y axis points down."""
    count = 500
    means = np.stack([rng.uniform(-2, 2, count), np.full(count, 1.5), rng.uniform(1, 5, count)], axis=1)
    log_scales = np.log(np.tile([0.05, 0.001, 0.05], (count, 1)))
    quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    grey, opaque = np.zeros((count, 3), np.float32), np.full(count, 3.0, np.float32)
    return Gaussians(means.astype(np.float32), quats, log_scales.astype(np.float32), opaque, grey)


def poses(*headings: float) -> np.ndarray:
    out = np.tile(np.eye(4), (len(headings), 1, 1))
    for T_wc, heading in zip(out, np.radians(headings), strict=True):
        T_wc[[0, 2, 0, 2], [0, 2, 2, 0]] = np.cos(heading), np.cos(heading), np.sin(heading), -np.sin(heading)
    return out


def test_the_first_view_is_upright_and_sees_most(rng: np.random.Generator) -> None:
    tilted = poses(150.0, 100.0, 0.0, 60.0)
    view = describe_view(floor(rng), CAMERA, tilted)
    assert view.up.source == "surfaces" and np.allclose(view.up.direction, [0.0, -1.0, 0.0], atol=1e-3)
    assert np.allclose(view.start, tilted[2], atol=1e-3)
    assert 1.0 < view.target[2] < 5.0 and abs(view.target[0]) < 1e-2


def test_an_empty_map_has_a_view_too(rng: np.random.Generator) -> None:
    view = describe_view(floor(rng).take(np.zeros(0, int)), CAMERA, poses(0.0))
    assert view.up.source == "camera" and np.allclose(view.target, [0.0, 0.0, 1.0])


def test_it_comes_back_from_its_file(tmp_path: Path, rng: np.random.Generator) -> None:
    view = describe_view(floor(rng), CAMERA, poses(0.0, 20.0))
    write_view(tmp_path, view)
    back = read_view(tmp_path)
    assert np.allclose(back.start, view.start, atol=1e-5) and np.allclose(back.target, view.target, atol=1e-4)
    assert np.allclose(back.up.direction, view.up.direction, atol=1e-5)
    assert (back.up.source, back.up.support) == ("surfaces", pytest.approx(view.up.support, abs=1e-4))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("up", [0, 0, 0]),
        ("up", [1, 2]),
        ("up", None),
        ("up_source", "stars"),
        ("start", [[1, 0, 0, 0]] * 4),
        ("start", "here"),
        ("target", [1e400, 0, 0]),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, key: str, value: object) -> None:
    write_view(tmp_path, SceneView(Up(np.array([0.0, 0.0, 1.0]), "given"), np.eye(4), np.zeros(3)))
    values = json.loads((tmp_path / "view.json").read_text())
    (tmp_path / "view.json").write_text(json.dumps(values | {key: value}))
    with pytest.raises(FileError, match=r"^.*view\.json: [^\n]+$"):
        read_view(tmp_path)


def test_a_file_that_is_no_object_is_refused(tmp_path: Path) -> None:
    (tmp_path / "view.json").write_text("[1]")
    with pytest.raises(FileError, match=r"view\.json"):
        read_view(tmp_path)


@pytest.mark.parametrize(
    ("text", "direction"),
    [("z", [0, 0, 1]), ("-y", [0, -1, 0]), ("0,3,4", [0, 0.6, 0.8]), ("-1 0 0", [-1, 0, 0])],
)
def test_up_as_a_user_says_it(text: str, direction: list[float]) -> None:
    up = parse_up(text)
    assert up is not None and up.source == "given" and np.allclose(up.direction, direction)


def test_up_by_itself_and_nonsense() -> None:
    assert parse_up("auto") is None
    for text in ("", "w", "--y", "1,2", "0,0,0", "a,b,c", "nan,0,0"):
        with pytest.raises(ValueError, match=r"--up .*give auto, x, -x"):
            parse_up(text)
