# SPDX-License-Identifier: Apache-2.0
"""Pieces of reports: charts, pictures, and pages of large runs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp.io.json import write_json
from ggwarp.io.table import write_table
from ggwarp.io.trajectory import write_tum
from ggwarp.report.charts import Line, line_chart, script_safe, thinned
from ggwarp.report.colours import (
    depth_in_colours,
    depth_limits,
    difference,
    object_colour,
    objects_in_colours,
)
from ggwarp.report.gallery import Gallery, read_gallery
from ggwarp.report.page import write_report
from ggwarp.results.run_folder import FRAME_COLUMNS
from ggwarp.types import Frame, Rendered
from small_run import wall_and_cubes, write_small_run


def test_thinning_keeps_the_extremes() -> None:
    x = np.arange(5000.0)
    y = np.sin(x / 300.0)
    y[1234], y[4321] = 9.0, -9.0
    y[2000:2100] = np.nan
    tx, ty = thinned(x, y)
    assert len(tx) <= 600 and np.nanmax(ty) == 9.0 and np.nanmin(ty) == -9.0 and np.isnan(ty).any()
    assert (np.diff(tx) > 0.0).all() and thinned(x[:50], y[:50])[0] is not None


def test_a_line_is_broken_where_nothing_was_measured() -> None:
    y = np.array([1.0, 2.0, np.nan, 3.0, np.nan, 4.0, 5.0])
    svg = line_chart("A & B", "m<s", [Line("one", np.arange(7.0), y)], marks=[2.0])
    path = re.search(r'class="line c0" d="([^"]+)"', svg)
    assert path and path[1].count("M") == 3 and path[1].count("h0.1") == 1
    assert "A &amp; B" in svg and "m&lt;s" in svg and svg.count('class="mark"') == 1
    data = json.loads(re.search(r"<script[^>]*>(.*)</script>", svg)[1].replace("\\u003c", "<"))  # type: ignore[index]
    assert [row[1] for row in data["lines"][0]["rows"]] == [1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize(
    "y", [[0.0, 0.0], [5.0, 5.0], [-3.0, -3.0], [1e-9, 2e-9], [0.0, 1e12], [np.nan, 7.0]]
)
def test_any_range_of_values_has_a_chart(y: list[float]) -> None:
    svg = line_chart("x", "", [Line("y", np.array([3.0, 4.0]), np.array(y))])
    numbers = [float(n) for n in re.findall(r"-?\d+\.?\d*", re.search(r'"line c0" d="([^"]+)"', svg)[1])]  # type: ignore[index]
    assert np.isfinite(numbers).all() and svg.count("<text") >= 4


def test_no_values_no_chart() -> None:
    assert line_chart("x", "", [Line("y", np.arange(3.0), np.full(3, np.nan))]) == ""


def test_nothing_ends_a_script() -> None:
    assert "</script>" not in script_safe({"name": "</script><b>"})


def test_depth_and_objects_in_colours() -> None:
    depth = np.tile(np.linspace(0.0, 3.0, 40, dtype=np.float32), (4, 1))
    near, far = depth_limits(depth)
    coloured = depth_in_colours(depth, (near, far)).astype(int)
    assert (coloured[:, 0] == 0).all(), "no reading is black"
    assert coloured[0, 2, 0] > coloured[0, 2, 2] and coloured[0, -2, 2] > coloured[0, -2, 0], (
        "near red, far blue"
    )
    assert depth_limits(np.zeros((2, 2), np.float32)) == (0.0, 1.0)
    assert len({object_colour(i) for i in range(200)}) == 200
    white = np.ones((2, 2, 3), np.float32)
    ids = np.array([[0, 3], [3, 7]])
    painted = objects_in_colours(ids, white)
    assert np.array_equal(painted[0, 1], painted[1, 0]) and not np.array_equal(painted[1, 1], painted[1, 0])
    assert not difference(white, np.full((2, 2, 3), 255, np.uint8)).any()


def view(ids: np.ndarray) -> Rendered:
    plane = np.ones(ids.shape, np.float32)
    rgb = np.zeros((*ids.shape, 3), np.float32)
    rgb[ids > 0] = 1.0
    return Rendered(rgb, plane, plane, plane, None, ids)


def test_the_gallery_has_the_worst_frame_and_objects_seen_whole(tmp_path: Path) -> None:
    gallery = Gallery(list(range(0, 60)))
    for index in range(60):
        ids = np.zeros((60, 80), np.int32)
        ids[20:40, 10 : 20 + index // 2] = 5  # grows
        ids[:30, 60:] = 9 if index != 33 else 0  # cut by the border, but once
        if index == 33:
            ids[5:15, 60:70] = 9
        frame = Frame(index, 0.0, np.full((60, 80, 3), index, np.uint8))
        gallery.add(frame, view(ids), psnr=10.0 if index == 41 else 30.0)
    gallery.write(tmp_path)
    frames, objects = read_gallery(tmp_path)
    assert list(frames) == [0, 6, 12, 18, 24, 30, 36, 41, 42, 48, 54]
    assert set(frames[41]) == {"frame", "render", "difference", "depth", "objects"}
    assert abs(int(cv2.imread(str(frames[41]["frame"])).mean()) - 41) <= 1
    largest = cv2.imread(str(objects[5]))
    assert largest.shape[1] > 40, "where it is largest"


def test_a_page_of_a_large_run_stays_small(tmp_path: Path) -> None:
    folder, rng = write_small_run(tmp_path / "run", wall_and_cubes()), np.random.default_rng(0)
    count = 6_000
    rows = [{name: float(rng.normal()) for name in FRAME_COLUMNS} for _ in range(count)]
    for index, row in enumerate(rows):
        row |= {"index": index, "verdict": "lost" if index % 3 else "converged", "loop_with": None}
    write_table(folder / "frames.csv", FRAME_COLUMNS, rows)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(count, 3)).cumsum(axis=0)
    write_tum(folder / "trajectory.txt", np.arange(count), poses)
    entry = json.loads((folder / "objects.json").read_text())["objects"][0]
    write_json(folder / "objects.json", {"objects": [entry | {"id": i + 1} for i in range(2000)]})
    (folder / "pictures").mkdir()
    for index in range(11):
        for kind in ("frame", "render", "difference", "depth", "objects"):
            (folder / "pictures" / f"frame{index:06d}_{kind}.jpg").write_bytes(rng.bytes(120_000))
    for index in range(1, 2001):
        (folder / "pictures" / f"object{index:06d}.jpg").write_bytes(rng.bytes(3000))
    write_report(folder)
    assert 2_000_000 < (folder / "report.html").stat().st_size <= 5_000_000
