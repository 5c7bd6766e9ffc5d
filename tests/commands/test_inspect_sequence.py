# SPDX-License-Identifier: Apache-2.0
"""ggwarp inspect: the plan in words or JSON, the sheet, and what it says where a sequence is unusable."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp.commands import inspect_sequence


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Seven frames of a box before a wall, with masks, and a folder that nobody reads."""
    folder = tmp_path / "my walk"
    for name in ("color", "depth", "object_mask", "thumbs"):
        (folder / name).mkdir(parents=True)
    for i in range(7):
        depth = np.full((48, 64), 3000, np.uint16)
        depth[10:30, 8 + i : 30 + i] = 1500
        near = depth == 1500
        cv2.imwrite(str(folder / f"color/{i}.png"), np.where(near, 200, 60).astype(np.uint8))
        cv2.imwrite(str(folder / f"depth/{i}.png"), depth)
        cv2.imwrite(str(folder / f"object_mask/{i}.png"), near.astype(np.uint8) * 5)
    camera = {"w": 64, "h": 48, "fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "scale": 1000}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def test_the_plan_and_a_sheet(recording: Path, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert inspect_sequence.main([str(recording)]) == 0
    out, errors = capsys.readouterr()
    assert out.splitlines()[0] == "sequence: a plain folder, color/ and depth/, 7 frames"
    assert "not read: thumbs/ (empty)" in out and "sheet:    inspect-my_walk.png" in out and not errors
    sheet = cv2.imread("inspect-my_walk.png")
    assert sheet is not None and sheet.shape == (6 * 244, 4 * 324, 3)
    first = sheet[:240, :1292].astype(int)
    colour, depth, edges, mask = (first[:, i * 324 : i * 324 + 320] for i in range(4))
    assert colour[100, 80].tolist() == [200] * 3 and colour[200, 80].tolist() == [60] * 3
    assert depth[100, 80, 2] > depth[100, 80, 0], "near is red"
    assert depth[200, 80, 0] > depth[200, 80, 2], "far is blue"
    assert (edges[50, 40:150] == (0, 0, 255)).all(axis=1).any() and edges[200, 80].tolist() == [60] * 3
    assert mask[100, 80].max() == 235 and mask[200, 80].max() == 0


def test_as_json_and_without_a_sheet(recording: Path, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (recording / "traj.txt").write_text("inf " * 16 + "\n")
    assert inspect_sequence.main([str(recording), "--json", "--sheet", "none", "--masks", "none"]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["frames"] == 7 and plan["masks"] == "none" and plan["median_depth_m"] == 3.0
    assert "hold no pose" in plan["messages"][0] and [p.name for p in Path().iterdir()] == ["my walk"]


def test_what_cannot_be_used_is_said(recording: Path, tmp_path, capsys) -> None:
    assert inspect_sequence.main([str(tmp_path / "absent")]) == 2
    (recording / "camera.json").write_text('{"fx": 50, "fy": 50, "cx": 90, "cy": 23}')
    assert inspect_sequence.main([str(recording)]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert "absent: no such sequence" in first and "cx 90 and cy 23, lies outside the 64x48 images" in second
    with pytest.raises(SystemExit):
        inspect_sequence.main([str(recording), "--sheet", "notes.txt"])


def test_warnings_go_to_standard_error(recording: Path, capsys) -> None:
    (recording / "camera.json").write_text('{"fx": 13, "fy": 10, "cx": 31.5, "cy": 23.5}')
    assert inspect_sequence.main([str(recording), "--sheet", "none"]) == 0
    out, errors = capsys.readouterr()
    assert "assumed, as no file says" in out
    assert [line.split(":")[0] for line in errors.splitlines()] == ["warning"] * 2


def test_it_starts_no_kernels(recording: Path) -> None:
    code = (
        "import sys; from ggwarp.commands.inspect_sequence import main; "
        f"main([{str(recording)!r}, '--sheet', 'none']); print('warp' in sys.modules, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False False"
