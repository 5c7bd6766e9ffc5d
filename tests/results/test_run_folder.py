# SPDX-License-Identifier: Apache-2.0
import csv
import json

import numpy as np
import pytest

from ggwarp.evaluation.evaluate import Evaluation, FrameScore
from ggwarp.evaluation.objects import ObjectRow
from ggwarp.io.ply import read_ply
from ggwarp.io.trajectory import read_tum
from ggwarp.map.gaussians import Gaussians
from ggwarp.objects.inventory import inventory
from ggwarp.objects.linear_classifier import LinearClassifier, read_classifier
from ggwarp.results import run_folder
from ggwarp.results.metrics import metrics_of


def test_trajectories(record, tmp_path):
    run_folder.write_trajectories(tmp_path, record)
    stamps, poses = read_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(stamps, [0, 2 / 30, 3 / 30], atol=1e-6)
    np.testing.assert_allclose(poses[:, 0, 3], [0, 0.1, 0.2])
    stamps, poses = read_tum(tmp_path / "trajectory_gt.txt")
    np.testing.assert_allclose(poses[:, 0, 3], [0, 0.24])


def test_poses_corrected_later_leave_what_was_reported_in_a_file_of_its_own(record, tmp_path):
    true = {0: np.eye(4), 3: np.eye(4)}
    true[3][0, 3] = 0.24
    record.correct(true)
    record.correct(true)  # what was reported is what came first
    run_folder.write_trajectories(tmp_path, record)
    np.testing.assert_allclose(read_tum(tmp_path / "trajectory.txt")[1][:, 0, 3], [0, 0.1, 0.24])
    np.testing.assert_allclose(read_tum(tmp_path / "trajectory_live.txt")[1][:, 0, 3], [0, 0.1, 0.2])
    metrics = metrics_of(record, wall_s=1.0, gaussians=0)
    assert metrics["ate_rmse_cm"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["ate_live_rmse_cm"] == pytest.approx(2.0)  # 4 cm, shared by alignment


def test_a_frame_that_was_mapped_later_is_a_keyframe(record, tmp_path):
    for _ in range(2):
        record.correct({}, mapped=[2])
    run_folder.write_frames(tmp_path, record)
    with (tmp_path / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["keyframe"] for row in rows] == ["", "", "mapping", ""]
    assert metrics_of(record, wall_s=1.0, gaussians=0)["mapping_keyframes"] == 2


def test_lost_frames_are_also_left_out_of_the_error(record):
    record.truth[2] = np.eye(4)
    record.truth[2][0, 3] = 0.12
    metrics = metrics_of(record, wall_s=1.0, gaussians=0)
    assert metrics["frames_lost"] == 1
    assert metrics["ate_tracked_rmse_cm"] == pytest.approx(1.0)
    assert metrics["ate_rmse_cm"] > 1.5, "the lost frame counts, 4 cm off"
    record.reports.pop()
    assert metrics_of(record, wall_s=1.0, gaussians=0)["ate_tracked_rmse_cm"] is None


def test_no_truth_no_file(record, tmp_path):
    record.truth = {}
    run_folder.write_trajectories(tmp_path, record)
    assert not (tmp_path / "trajectory_gt.txt").exists()
    assert metrics_of(record, wall_s=1.0, gaussians=0)["ate_rmse_cm"] is None


def test_a_row_for_every_frame(record, tmp_path):
    record.evaluation = Evaluation(per_frame=[FrameScore(2, True, 31.5, 32.0, 0.9, None, 1.2)])
    run_folder.write_frames(tmp_path, record)
    with (tmp_path / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [r["index"] for r in rows] == ["0", "1", "2", "3"]
    assert [r["verdict"] for r in rows] == ["converged", "skipped", "converged", "lost"]
    assert rows[1]["reason"] == "frame000001.jpg: damaged" and rows[1]["psnr"] == ""
    assert rows[2]["held_out"] == "1" and float(rows[2]["psnr"]) == 31.5 and rows[2]["ate_cm"] == ""
    assert (
        float(rows[2]["latency_ms"]) == 30.0
        and rows[2]["frames_behind"] == "1"
        and rows[1]["latency_ms"] == ""
    )
    assert rows[3]["loss"] == "" and float(rows[3]["ate_cm"]) == pytest.approx(2.0)
    assert float(rows[0]["rmse_mm"]) == pytest.approx(1.0)


def test_a_row_for_every_true_object(record, tmp_path):
    record.class_names = {5: "chair"}
    record.evaluation = Evaluation(
        objects=[ObjectRow(2, 40, 0, 0.0, None, None, 0.0), ObjectRow(5, 100, 90, 0.75, 0.8, 7, 0.9)]
    )
    run_folder.write_object_scores(tmp_path, record)
    with (tmp_path / "object_scores.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["id"], r["name"], r["pixels"], r["matched_id"]) for r in rows] == [
        ("2", "", "40", ""),
        ("5", "chair", "100", "7"),
    ]
    assert [r["iou_interior"] for r in rows] == ["", "0.800000"] and float(rows[1]["iou_matched"]) == 0.9


def test_no_objects_compared_no_rows(record, tmp_path):
    run_folder.write_object_scores(tmp_path, record)
    assert (tmp_path / "object_scores.csv").read_text().splitlines() == [",".join(run_folder.OBJECT_COLUMNS)]


def test_map_and_objects(rng, tmp_path):
    n = 50
    gaussians = Gaussians(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        log_scales=np.full((n, 3), -4.0, np.float32),
        opacity_logits=np.zeros(n, np.float32),
        colours=np.zeros((n, 3), np.float32),
        object_ids=np.repeat([0, 5], n // 2).astype(np.int32),
    )
    assert gaussians.object_ids is not None
    objects = inventory(gaussians.means, gaussians.colours, gaussians.object_ids, names={5: "chair"})
    classifier = LinearClassifier(np.ones((2, 16), np.float32), np.zeros(2, np.float32), np.array([0, 5]))
    run_folder.write_map(tmp_path, lambda: [gaussians])
    run_folder.write_objects(tmp_path, objects)
    run_folder.write_identities(tmp_path, classifier)
    np.testing.assert_array_equal(read_ply(tmp_path / "map.ply").means, gaussians.means)
    objects = json.loads((tmp_path / "objects.json").read_text())["objects"]
    assert [(o["id"], o["count"], o["class"]) for o in objects] == [(5, 25, "chair")]
    np.testing.assert_array_equal(read_classifier(tmp_path / "classifier.npz").ids, [0, 5])
