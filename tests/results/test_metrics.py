# SPDX-License-Identifier: Apache-2.0
import dataclasses
import json

import pytest

from ggwarp.evaluation.evaluate import Evaluation, FrameScore, Scores
from ggwarp.results import run_folder
from ggwarp.results.metrics import metrics_of
from ggwarp.results.record import RunRecord
from ggwarp.types import Verdict

KEYS = (
    "sequence dataset device frames fps wall_s tracking_ms mapping_ms mapping_iterations ate_rmse_cm "
    "ate_mean_cm psnr ssim lpips depth_l1_cm miou gaussians tracking_keyframes mapping_keyframes frames_lost "
    "frames_skipped peak_memory_mb heldout_psnr heldout_ssim heldout_lpips heldout_depth_l1_cm heldout_miou "
    "miou_matched miou_interior heldout_miou_matched heldout_miou_interior pixel_accuracy pq sq rq "
    "objects_true objects_found miou_against"
).split()


def test_metrics(record):
    record.evaluation = Evaluation(
        Scores(
            3,
            30.0,
            30.5,
            0.9,
            None,
            1.0,
            miou=0.8,
            miou_matched=0.85,
            pq=0.7,
            objects_true=4,
            objects_found=5,
        ),
        Scores(1, 28.0, miou_interior=0.9),
        [FrameScore(0, False, 30.0, 30.5, 0.9, None, 1.0)],
        "truth",
    )
    metrics = metrics_of(record, wall_s=9.0, gaussians=123)
    assert set(KEYS) <= set(metrics)
    assert metrics["frames"] == 3 and metrics["fps"] == 2.0 and metrics["wall_s"] == 9.0
    assert metrics["tracking_ms"] == 10.0 and metrics["mapping_ms"] == 30.0
    assert metrics["mapping_iterations"] == 12 and metrics["gaussians"] == 123
    assert metrics["ate_rmse_cm"] == pytest.approx(2.0)  # 4 cm between two poses, shared by alignment
    assert metrics["ate_mean_cm"] == pytest.approx(2.0)
    assert metrics["iterations_per_frame"] == 4.0
    assert metrics["latency_ms_p50"] == 30.0 and metrics["latency_ms_p95"] == pytest.approx(39.0)
    assert (
        metrics["frames_late"] == 2 and metrics["late_ms_max"] == 20.0 and metrics["frames_behind_max"] == 1
    )
    assert metrics["refine_iterations"] == 0 and metrics["refine_s"] == 0.0
    assert metrics["frames_lost"] == 1 and metrics["frames_skipped"] == 1
    assert metrics["psnr"] == 30.0 and metrics["heldout_psnr"] == 28.0 and metrics["heldout_frames"] == 1
    assert metrics["lpips"] is None and metrics["heldout_miou"] is None
    assert (metrics["miou"], metrics["miou_matched"], metrics["miou_interior"]) == (0.8, 0.85, None)
    assert metrics["heldout_miou_interior"] == 0.9 and metrics["pq"] == 0.7
    assert (metrics["objects_true"], metrics["objects_found"]) == (4, 5)
    assert metrics["miou_against"] == "truth"
    assert metrics["peak_memory_mb"] > 10.0


def test_a_monocular_trajectory_is_aligned_with_its_scale(record):
    rigid = metrics_of(record, wall_s=9.0, gaussians=123)
    assert rigid["alignment"] == "se3" and rigid["scale"] is None
    record.monocular = True
    metrics = metrics_of(record, wall_s=9.0, gaussians=123)
    assert metrics["alignment"] == "sim3" and metrics["scale"] == pytest.approx(1.2)
    assert metrics["ate_rmse_cm"] == pytest.approx(0.0, abs=1e-9)
    record.truth = {}
    assert metrics_of(record, wall_s=9.0, gaussians=123)["alignment"] is None


def test_a_camera_that_was_never_tracked_has_no_error(record):
    assert len(record.reports) > 1
    record.reports[1:] = [dataclasses.replace(r, verdict=Verdict.LOST) for r in record.reports[1:]]
    assert metrics_of(record, wall_s=9.0, gaussians=123)["ate_rmse_cm"] is None


def test_what_was_not_measured_is_null(tmp_path):
    metrics = metrics_of(RunRecord("s", "folder", "cpu"), wall_s=1.0, gaussians=0)
    run_folder.write_metrics(tmp_path, {**metrics, "psnr": float("inf")})
    read = json.loads((tmp_path / "metrics.json").read_text())
    for key in (
        "fps",
        "tracking_ms",
        "latency_ms_p95",
        "frames_behind_max",
        "ate_rmse_cm",
        "psnr",
        "ssim",
        "miou",
        "heldout_psnr",
        "heldout_frames",
    ):
        assert read[key] is None
