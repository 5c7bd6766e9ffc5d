# SPDX-License-Identifier: Apache-2.0
"""The measure of a removal, on a tiny office."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from ggwarp import run
from ggwarp.results.saved_run import load_run

_SPEC = importlib.util.spec_from_file_location(
    "evaluate_removal", Path(__file__).parents[2] / "tools" / "evaluate_removal.py"
)
assert _SPEC is not None and _SPEC.loader is not None
tool = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = tool  # where dataclasses look their module up
_SPEC.loader.exec_module(tool)


@pytest.fixture(scope="module")
def office_run(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("run") / "office"
    options = ["--seq", "office", "--scale", "0.1", "--device", "cpu", "--frames", "62:104:6"]
    assert run.main([*options, "--tracker", "ground-truth", "--save-renders", "0", "--out", str(out)]) == 0
    return out


def test_a_hole_is_measured_against_the_office_without_the_object(office_run, tmp_path, capsys):
    assert tool.main([str(office_run), "stool", "--step", "1", "--pictures", str(tmp_path)]) == 0
    header, row, summary = capsys.readouterr().out.splitlines()[-3:]
    row = row.removeprefix("46 ")
    figures = dict(zip(header.split()[1:], row.removeprefix("stool").split(), strict=True))
    assert int(figures["views"]) >= 2 and int(figures["pixels"]) > 300 and int(figures["added"]) > 20
    removed, hole = row.split()[5:7]
    assert float(hole) > float(removed) + 2.0
    assert abs(float(figures["change"])) < 0.5
    assert summary.startswith("1 objects: median") and summary.endswith("filling is worse in 0")
    picture = cv2.imread(str(tmp_path / f"{load_run(office_run).find('stool').id}.png"))
    assert picture is not None and picture.shape == (68, 4 * 120, 3)


def test_the_true_background_is_known(office_run):
    saved = load_run(office_run)
    office = tool.Office([68, 92], saved.camera, shade_goes=False)
    record = saved.find("stool")
    view = office.views(record.id, 1)[0]
    assert view.hole.any() and (view.frame.mask == record.id).sum() == view.hole.sum()
    away = ~cv2.dilate(view.hole.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    np.testing.assert_array_equal(view.frame.rgb[away], view.empty.rgb[away])
    assert np.mean(view.empty.depth[view.hole] > view.frame.depth[view.hole] + 0.01) > 0.8
    # Two frames alone: most of what is behind was not seen; what was lies elsewhere in the other frame.
    assert view.unseen.any() and not (view.unseen & ~view.hole).any()


def _box(number: int, name: str, low: tuple, high: tuple) -> SimpleNamespace:
    return SimpleNamespace(id=number, name=name, box=SimpleNamespace(low=low, high=high))


def test_what_carries_others_stays():
    table, bowl = (
        _box(3, "table", (0, 0, 0.02), (1, 1, 0.5)),
        _box(4, "bowl", (0.4, 0.4, 0.51), (0.6, 0.6, 0.6)),
    )
    beside = _box(5, "ball", (0.2, 0.2, 0.0), (0.3, 0.3, 0.1))  # under it, on the floor
    wall, rug = _box(1, "north wall", (0, 2, 0), (9, 2.1, 3)), _box(2, "rug", (-1, -1, 0), (3, 3, 0.02))
    found = tool.removable([wall, rug, table, bowl, beside])
    assert [o.id for o in found] == [4, 5]
    assert [o.id for o in tool.removable([wall, rug, bowl])] == [2, 4]


def test_the_summary_counts():
    rows = [{"pixels": p, "hole": h, "hole_removed": 20.0} for p, h in ((9, 19.0), (9, 25.0), (0, np.nan))]
    assert tool.summary(rows) == (
        "2 objects: median 22.0 dB (removed alone 20.0), 1 at 22 dB or more (0); filling is worse in 1"
    )
    assert "no frame" in tool.summary([])


def test_mistakes(office_run, tmp_path, capsys):
    assert tool.main([str(tmp_path), "5"]) == 2
    assert tool.main([str(office_run), "nothing"]) == 2
    assert len([line for line in capsys.readouterr().err.splitlines() if line]) == 2
