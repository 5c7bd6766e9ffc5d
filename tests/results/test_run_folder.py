# SPDX-License-Identifier: Apache-2.0
import csv
import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggwarp.evaluation.evaluate import Evaluation, FrameScore, Scores
from ggwarp.evaluation.objects import ObjectRow
from ggwarp.io.ply import PlyGaussians, read_ply
from ggwarp.io.trajectory import read_tum
from ggwarp.objects.inventory import inventory
from ggwarp.objects.linear_classifier import LinearClassifier, read_classifier
from ggwarp.results import renders, run_folder
from ggwarp.types import Rendered, StepReport, Verdict

KEYS = (
    "sequence dataset device frames fps wall_s tracking_ms mapping_ms mapping_iterations ate_rmse_cm "
    "ate_mean_cm psnr ssim lpips depth_l1_cm miou gaussians tracking_keyframes mapping_keyframes frames_lost "
    "frames_skipped peak_memory_mb heldout_psnr heldout_ssim heldout_lpips heldout_depth_l1_cm heldout_miou "
    "miou_matched miou_interior heldout_miou_matched heldout_miou_interior pixel_accuracy pq sq rq "
    "objects_true objects_found miou_against"
).split()


def _pose(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def _step(index: int, x: float, verdict: Verdict = Verdict.CONVERGED, loss: float = 0.5) -> StepReport:
    return StepReport(
        index, index / 30, _pose(x), verdict, "", 0.9, 0.001, "", 10.0, 30.0, 4, 100, loss,
        latency_ms=10.0 * (1 + index), late_ms=max(0.0, 10.0 * (index - 1)), frames_behind=index // 2,
    )  # fmt: skip


@pytest.fixture
def record() -> run_folder.RunRecord:
    """Three of four frames, one of them without a true pose."""
    return run_folder.RunRecord(
        "office",
        "synthetic",
        "cpu",
        reports=[_step(0, 0.0), _step(2, 0.1), _step(3, 0.2, Verdict.LOST, float("nan"))],
        truth={0: _pose(0.0), 3: _pose(0.24)},
        skipped={1: "frame000001.jpg: damaged"},
        counts={"tracking_keyframes": 1, "mapping_keyframes": 1, "frames_lost": 1},
        loop_s=1.5,
    )


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
    metrics = run_folder.metrics_of(record, wall_s=9.0, gaussians=123)
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
    rigid = run_folder.metrics_of(record, wall_s=9.0, gaussians=123)
    assert rigid["alignment"] == "se3" and rigid["scale"] is None
    record.monocular = True
    metrics = run_folder.metrics_of(record, wall_s=9.0, gaussians=123)
    assert metrics["alignment"] == "sim3" and metrics["scale"] == pytest.approx(1.2)
    assert metrics["ate_rmse_cm"] == pytest.approx(0.0, abs=1e-9)
    record.truth = {}
    assert run_folder.metrics_of(record, wall_s=9.0, gaussians=123)["alignment"] is None


def test_a_camera_that_was_never_tracked_has_no_error(record):
    assert len(record.reports) > 1
    record.reports[1:] = [dataclasses.replace(r, verdict=Verdict.LOST) for r in record.reports[1:]]
    assert run_folder.metrics_of(record, wall_s=9.0, gaussians=123)["ate_rmse_cm"] is None


def test_what_was_not_measured_is_null(tmp_path):
    metrics = run_folder.metrics_of(run_folder.RunRecord("s", "folder", "cpu"), wall_s=1.0, gaussians=0)
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


def test_trajectories(record, tmp_path):
    run_folder.write_trajectories(tmp_path, record)
    stamps, poses = read_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(stamps, [0, 2 / 30, 3 / 30], atol=1e-6)
    np.testing.assert_allclose(poses[:, 0, 3], [0, 0.1, 0.2])
    stamps, poses = read_tum(tmp_path / "trajectory_gt.txt")
    np.testing.assert_allclose(poses[:, 0, 3], [0, 0.24])


def test_no_truth_no_file(record, tmp_path):
    record.truth = {}
    run_folder.write_trajectories(tmp_path, record)
    assert not (tmp_path / "trajectory_gt.txt").exists()
    assert run_folder.metrics_of(record, wall_s=1.0, gaussians=0)["ate_rmse_cm"] is None


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
    gaussians = PlyGaussians(
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
    run_folder.write_map(tmp_path, gaussians, objects, classifier)
    np.testing.assert_array_equal(read_ply(tmp_path / "map.ply").means, gaussians.means)
    objects = json.loads((tmp_path / "objects.json").read_text())["objects"]
    assert [(o["id"], o["count"], o["class"]) for o in objects] == [(5, 25, "chair")]
    np.testing.assert_array_equal(read_classifier(tmp_path / "classifier.npz").ids, [0, 5])


def test_run_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = run_folder.create_run_folder(None, "fr1/xyz")
    two = run_folder.create_run_folder(None, "fr1/xyz")
    assert one != two and one.parent == two.parent == Path("runs/fr1_xyz")
    assert Path("runs/latest").resolve() == two.resolve()
    given = run_folder.create_run_folder(Path("a/b"), "x")
    assert given == Path("a/b") and given.is_dir()


def test_an_earlier_run_leaves_nothing_behind(tmp_path):
    (tmp_path / "renders").mkdir()
    for name in ("trajectory_gt.txt", "renders/frame000007_rgb.png", "renders/mine.png", "notes.txt"):
        (tmp_path / name).write_text("old")
    run_folder.create_run_folder(tmp_path, "x")
    left = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert left == {"renders/mine.png", "notes.txt"}


def _read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def test_renders(rng, tmp_path):
    shape = (6, 8)
    objects = np.zeros(shape, np.int32)
    objects[0, 0] = 300
    identity = rng.normal(size=(*shape, 16)).astype(np.float32)
    view = Rendered(
        rgb=np.broadcast_to(np.float32([1.0, 0.5, 0.0]), (*shape, 3)),
        depth=np.full(shape, 1.2345, np.float32),
        median_depth=np.full(shape, 1.2345, np.float32),
        opacity=np.ones(shape, np.float32),
        identity=identity,
        objects=objects,
    )
    writer = renders.RenderWriter(tmp_path / "renders", identity.reshape(-1, 16))
    writer.write(42, view)
    files = {p.name for p in (tmp_path / "renders").iterdir()}
    assert files == {f"frame000042_{w}.png" for w in ("rgb", "depth", "objects", "features")}
    assert _read(tmp_path / "renders/frame000042_rgb.png")[0, 0].tolist() == [0, 128, 255]  # BGR
    depth = _read(tmp_path / "renders/frame000042_depth.png")
    assert depth.dtype == np.uint16 and np.isin(depth, (1234, 1235)).all()
    ids = _read(tmp_path / "renders/frame000042_objects.png")
    assert ids.dtype == np.uint16 and ids[0, 0] == 300 and ids.sum() == 300


def test_depth_that_has_no_place_in_16_bits():
    depth = np.array([[np.nan, np.inf, -1.0, 70.0, 0.001]], np.float32)
    assert renders.depth_to_millimetres(depth).tolist() == [[0, 0, 0, 65535, 1]]


def test_feature_colours_do_not_depend_on_the_eigenvectors_sign(rng):
    identities = rng.normal(size=(500, 16)).astype(np.float32) * np.linspace(2, 0.1, 16, dtype=np.float32)
    mean, axes = renders.feature_basis(identities)
    shuffled_mean, shuffled_axes = renders.feature_basis(identities[rng.permutation(500)])
    np.testing.assert_allclose(mean, shuffled_mean, atol=1e-5)
    np.testing.assert_allclose(axes, shuffled_axes, atol=1e-4)
    image = renders.feature_image(identities.reshape(20, 25, 16), (mean, axes))
    assert image.shape == (20, 25, 3) and image.std() > 30
