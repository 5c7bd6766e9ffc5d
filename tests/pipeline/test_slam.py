# SPDX-License-Identifier: Apache-2.0
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.pipeline.tracking.keyframe_policy import CovisibilityConfig, KeyframeConfig
from ggwarp.results.saved_run import load_run
from ggwarp.runtime.image_store import ImageStore
from ggwarp.types import Frame, Verdict

OFFICE = SyntheticOffice(scale=0.15)
CONFIG = SlamConfig(mapper=MapperConfig(iterations=3))


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [OFFICE[i] for i in range(5)]


def made(device: str) -> Slam:
    return Slam(CONFIG, OFFICE.camera, OFFICE.camera, device=device)


def error_cm(T: np.ndarray, truth: np.ndarray | None) -> float:
    assert truth is not None
    return 100.0 * float(np.linalg.norm(T[:3, 3] - truth[:3, 3]))


def test_a_lost_frame_never_enters_the_map_and_the_next_one_is_found(
    device: str, frames: list[Frame], rng: np.random.Generator
) -> None:
    slam = made(device)
    for frame in frames[:3]:
        slam.step(frame)
    before, keyframes = slam.map.count, slam.keyframe_indices
    assert frames[3].depth is not None
    noise = rng.uniform(0.3, 6.0, frames[3].depth.shape).astype(np.float32)

    lost = slam.step(dataclasses.replace(frames[3], depth=noise))
    found = slam.step(frames[4])

    assert lost.verdict is Verdict.LOST and lost.reason and lost.keyframe == ""
    assert lost.gaussians == before and slam.keyframe_indices[: len(keyframes)] == keyframes
    assert 3 not in slam.keyframe_indices
    assert slam.counts["frames_lost"] == 1
    assert found.verdict is not Verdict.LOST and error_cm(found.T_wc, frames[4].T_wc) < 1.0


def test_only_the_first_true_pose_is_used(device: str, frames: list[Frame]) -> None:
    slam, blind = made(device), made(device)
    for frame in frames:
        slam.step(frame)
        blind.step(frame if frame.index == 0 else dataclasses.replace(frame, T_wc=se3.se3_exp([9] * 6)))
    for a, b in zip(slam.reports, blind.reports, strict=True):
        assert (a.T_wc == b.T_wc).all() and a.gaussians == b.gaussians


def test_without_truth_the_first_camera_is_the_world(device: str, frames: list[Frame]) -> None:
    slam = made(device)
    for frame in frames[:2]:
        slam.step(dataclasses.replace(frame, T_wc=None))
    assert (slam.reports[0].T_wc == np.eye(4)).all()
    assert frames[0].T_wc is not None and frames[1].T_wc is not None
    assert error_cm(slam.reports[1].T_wc, se3.inverse(frames[0].T_wc) @ frames[1].T_wc) < 1.0


def test_a_blind_start_waits_for_depth(device: str, frames: list[Frame]) -> None:
    slam = made(device)
    assert frames[0].depth is not None
    first = slam.step(dataclasses.replace(frames[0], depth=np.zeros_like(frames[0].depth)))
    second = slam.step(frames[1])
    assert first.verdict is Verdict.LOST and first.gaussians == 0
    assert second.keyframe == "tracking" and second.gaussians > 0


def test_covisible_keyframes_are_fitted_with_their_poses(device: str, frames: list[Frame]) -> None:
    config = dataclasses.replace(
        CONFIG,
        mapper=dataclasses.replace(CONFIG.mapper, pose_rates=(1e-4, 1e-4)),
        policy="covisibility",
        covisibility=CovisibilityConfig(interval=2, min_translation=0.0, overlap=1.0),
        use_identity=False,
    )
    slam = Slam(config, OFFICE.camera, OFFICE.camera, device=device)
    assert slam.sequential_only, "the keyframes depend on the Gaussians"
    for frame in frames:
        slam.step(frame)
    tracked = {r.index: r.T_wc for r in slam.reports}
    fitted = slam.fitted_poses()
    assert slam.keyframe_indices == [0, 2, 4]
    assert list(fitted) == list(tracked)
    moved = [i for i, T in fitted.items() if not np.allclose(T, tracked[i], atol=1e-6)]
    assert moved == [2, 4], "keyframes but the first, which holds the world in place"
    assert all(error_cm(T, frames[i].T_wc) < 1.0 for i, T in fitted.items())


@pytest.mark.parametrize("use_identity", [True, False])
def test_what_is_saved_is_opened(frames: list[Frame], tmp_path: Path, use_identity: bool) -> None:
    config = dataclasses.replace(CONFIG, use_identity=use_identity)
    slam = Slam(config, OFFICE.camera, OFFICE.camera)
    for frame in frames[:2]:
        slam.step(frame)
    slam.save(tmp_path / "new" / "run")

    run = load_run(tmp_path / "new" / "run")

    assert (run.gaussians.means == slam.map_arrays().means).all() and run.camera == OFFICE.camera
    np.testing.assert_allclose(run.poses, [r.T_wc for r in slam.reports], atol=1e-6)
    described = [(o.id, o.count, o.views) for o in slam.objects({})]
    assert [(o.id, o.count, o.views) for o in run.objects] == described and bool(described) is use_identity
    assert (run.classifier is not None) is use_identity and run.edits == ()


@pytest.mark.parametrize("policy", ["overlap", "covisibility"])
def test_a_tiny_budget_of_memory_changes_no_bit(frames: list[Frame], policy: str) -> None:
    rates = {} if policy == "overlap" else {"pose_rates": (1e-4, 1e-4), "exposure_rate": 0.01}
    config = dataclasses.replace(
        CONFIG,
        mapper=dataclasses.replace(CONFIG.mapper, **rates),
        policy=policy,
        keyframes=KeyframeConfig(overlap=1.1),
        covisibility=CovisibilityConfig(interval=1, min_translation=0.0, overlap=1.0),
    )
    stores = [ImageStore(device="cpu"), ImageStore(device="cpu", budget=0)]
    systems = [Slam(config, OFFICE.camera, OFFICE.camera, images=store) for store in stores]
    for frame in frames:
        one, other = [dataclasses.astuple(slam.step(frame)) for slam in systems]
        for a, b in zip(one[2:8], other[2:8], strict=True):
            np.testing.assert_array_equal(a, b)
    for slam in systems:
        slam.refine()

    assert len(systems[0].keyframe_indices) == 5 and len(stores[0]) == 15
    assert stores[0].stored == 0 < stores[1].stored and stores[1].held < stores[0].held / 3
    one, other = [vars(slam.map_arrays()) for slam in systems]
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)
    one, other = [slam.fitted_poses() for slam in systems]
    np.testing.assert_array_equal(list(one.values()), list(other.values()))
