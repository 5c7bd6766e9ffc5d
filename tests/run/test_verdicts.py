# SPDX-License-Identifier: Apache-2.0
"""What a run says of its input: the plan at the start, total failure and doubtful truth at the end, typos."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from fake_slam import FRAMES, only_line
from ggwarp import run
from ggwarp.messages import total_failure
from ggwarp.types import StepReport, Verdict


def report(index: int, verdict: Verdict = Verdict.LOST, gaussians: int = 7) -> StepReport:
    reason = f"{index} depth points, 200 needed" if verdict is Verdict.LOST else ""
    return StepReport(index, 0.0, np.eye(4), verdict, reason, 0, 0, "", 0, 0, 0, gaussians, loss=0.0)


LOST = [report(0, Verdict.CONVERGED), *(report(i) for i in range(1, 6))]


@pytest.mark.parametrize(
    ("reports", "plan", "says"),
    [
        (LOST, {"median_depth_m": 2.0, "valid_depth": 0.01}, "only 1 % of the pixels have a depth reading"),
        (LOST, {"median_depth_m": 25.0, "valid_depth": 1.0}, "25 m, and beyond --gicp.far 12 depth is not"),
        (LOST, {"median_depth_m": 0.05, "valid_depth": 1.0}, "0.05 m, and nearer than 0.1 m it is not used"),
        (LOST, {"median_depth_m": 2.0, "valid_depth": 1.0, "warnings": ["odd pairs"]}, "likely: odd pairs"),
        (LOST, {"median_depth_m": 2.0, "valid_depth": 1.0}, "likely: 1 depth points, 200 needed"),
        ([report(i) for i in range(3)], {}, "3 of 3 frames were lost"),
        ([report(0, Verdict.CONVERGED, 0)], {}, "the map is empty"),
    ],
)  # fmt: skip
def test_total_failure_names_the_likely_cause(reports: list, plan: dict, says: str) -> None:
    assert says in total_failure(reports, plan, 12.0)


@pytest.mark.parametrize(
    "reports",
    [[], LOST[:2], [*LOST, report(6, Verdict.POOR)], [report(i, Verdict.CONVERGED) for i in range(4)]],
)
def test_a_partial_failure_is_none(reports: list) -> None:
    assert total_failure(reports, {"median_depth_m": 50.0, "valid_depth": 1.0}, 12.0) == ""


def test_a_run_that_loses_every_frame_fails(scene, fake, monkeypatch, capsys) -> None:
    whole = fake._report

    def lost(slam, frame, iterations):
        return dataclasses.replace(whole(slam, frame, iterations), verdict=Verdict.LOST, reason="no overlap")

    monkeypatch.setattr(fake, "_report", lost)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o", "-q"]) == 1
    out, errors = capsys.readouterr()
    reason = "6 of 6 frames were lost; likely: no overlap"
    assert errors.splitlines()[-1] == f"ggwarp: {reason}" and "the rest is in o" in out
    metrics = json.loads(Path("o/metrics.json").read_text())
    assert metrics["failures"] == [reason] and metrics["psnr"] is None and metrics["frames"] == FRAMES


def test_the_plan_is_said_and_kept(scene, fake, capsys) -> None:
    (scene / "leftovers").mkdir()
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[1] == "sequence: Replica's layout, results/, 6 frames"
    assert "not read: leftovers/ (empty)" in out[:9]
    plan = json.loads(Path("o/metrics.json").read_text())["plan"]
    assert plan["pairing"] == "6 pairs by number" and plan["median_depth_m"] == 2.0 and plan["warnings"] == []


def test_depth_that_cannot_be_right_is_refused_before_anything_is_made(scene, fake, capsys) -> None:
    for i in range(FRAMES):
        cv2.imwrite(str(scene / f"results/depth{i:06d}.png"), np.full((48, 64), 3, np.uint16))
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 2
    assert only_line(capsys).startswith("ggwarp: room9: the median depth is 0.003 m, as 1000 is taken for")
    assert not Path("o").exists()


def test_truth_of_other_axes_is_doubted(scene, fake, monkeypatch, capsys) -> None:
    """The estimate walks and turns; the truth is the same with OpenGL's axes."""
    whole, rows = fake._report, []

    def estimate(index: int) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.2 * index, 0.05 * index]))[0]
        T[:3, 3] = 0.1 * index, 0.02 * index**2, 0.0
        return T

    def right(slam, frame, iterations):
        return dataclasses.replace(whole(slam, frame, iterations), T_wc=estimate(frame.index))

    for i in range(FRAMES):
        rows.append(" ".join(map(str, (estimate(i) @ np.diag([1.0, -1.0, -1.0, 1.0])).ravel())))
    (scene / "traj.txt").write_text("\n".join(rows) + "\n")
    monkeypatch.setattr(fake, "_report", right)
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "o"]) == 0
    assert "times better if their cameras have OpenGL's axes" in only_line(capsys)
    assert "OpenGL" in json.loads(Path("o/metrics.json").read_text())["truth_doubt"]


def test_the_recording_is_no_run_folder(scene, fake, capsys) -> None:
    before = {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()}
    for out in (scene, scene / "results", scene.parent):
        assert run.main(["--seq", "room9", "--device", "cpu", "--out", str(out)]) == 2
        assert "holds other files and no run" in only_line(capsys)
    assert before == {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (["--frmes", "0:3"], "--frames"),
        (["--gicp.pionts", "3"], "--gicp.points"),
        (["--masks-kind", "untraked"], "untracked"),
        (["--preset", "qualiti"], "quality"),
        (["--seq", "rom9"], "room9"),
    ],
)
def test_a_typo_is_told_the_nearest(scene, fake, capsys, typed, meant) -> None:
    assert run.main(["--seq", "room9", "--device", "cpu", *typed]) == 2
    assert f"(did you mean {meant}?)" in only_line(capsys)
