# SPDX-License-Identifier: Apache-2.0
"""Trackers that look at pictures: at the map's alone, and at earlier ones as a help to G-ICP."""

import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice, SyntheticWall
from ggwarp.geometry import se3
from ggwarp.pipeline.mapping.mapper import MapperConfig
from ggwarp.pipeline.slam import Slam, SlamConfig
from ggwarp.pipeline.tracking.pose_descent import edge_mask
from ggwarp.pipeline.tracking.pose_refinement import RefinementConfig
from ggwarp.types import Frame, Verdict

OFFICE = SyntheticOffice(scale=0.15)
WALL = SyntheticWall(scale=0.15)
CONFIG = SlamConfig(tracker="gicp", mapper=MapperConfig(iterations=8), use_identity=False)
PHOTOMETRIC = dataclasses.replace(
    CONFIG, mapper=MapperConfig(iterations=8, bootstrap=50), tracker="photometric", policy="covisibility"
)
HYBRID = dataclasses.replace(CONFIG, tracker="hybrid")


def run(config: SlamConfig, frames: list[Frame], device: str = "cpu") -> Slam:
    camera = OFFICE.camera if frames[0].rgb.shape[1] == OFFICE.camera.width else WALL.camera
    slam = Slam(config, camera, camera, device=device)
    for frame in frames:
        slam.step(frame)
    return slam


def errors_cm(slam: Slam, frames: list[Frame]) -> list[float]:
    pairs = zip(slam.reports, frames, strict=True)
    return [100.0 * float(np.linalg.norm(r.T_wc[:3, 3] - f.T_wc[:3, 3])) for r, f in pairs]


@pytest.fixture(scope="module")
def office() -> list[Frame]:
    return [OFFICE[i] for i in range(6)]


@pytest.fixture(scope="module")
def wall() -> list[Frame]:
    return [WALL[i] for i in range(8)]


def test_on_a_wall_colour_holds_where_geometry_slides(device: str, wall: list[Frame]) -> None:
    std, held = run(CONFIG, wall, device), run(HYBRID, wall, device)
    assert max(errors_cm(held, wall)) < 1.0 < max(errors_cm(std, wall))
    assert held.counts["frames_lost"] == 0
    assert not held.sequential_only, "it does not look at the Gaussians"
    assert {r.verdict for r in held.reports} == {Verdict.CONVERGED}


def test_with_clean_depth_and_walls_around_colour_is_not_asked(device: str, office: list[Frame]) -> None:
    gicp, hybrid = run(CONFIG, office, device), run(HYBRID, office, device)
    for a, b in zip(gicp.reports, hybrid.reports, strict=True):
        assert (a.T_wc == b.T_wc).all() and a.loss == b.loss


def test_with_a_noisy_sensor_colour_is_asked(office: list[Frame], rng: np.random.Generator) -> None:
    noisy = [
        dataclasses.replace(
            f, depth=f.depth * (1 + 0.005 * rng.normal(size=f.depth.shape)).astype(np.float32)
        )
        for f in office
    ]
    gicp, hybrid = run(CONFIG, noisy), run(HYBRID, noisy)
    assert any((a.T_wc != b.T_wc).any() for a, b in zip(gicp.reports, hybrid.reports, strict=True))
    assert max(errors_cm(hybrid, noisy)) < 2.0


def test_pictures_alone_track_without_depth_or_truth(device: str, office: list[Frame]) -> None:
    blind = [
        f if f.index == 0 else dataclasses.replace(f, T_wc=se3.se3_exp([9] * 6), sensor_depth=None)
        for f in office
    ]
    slam = run(PHOTOMETRIC, blind, device)
    assert max(errors_cm(slam, office)) < 2.0
    assert slam.sequential_only and slam.counts["tracking_keyframes"] == 0


def test_a_picture_of_something_else_is_lost_and_the_next_one_found(office: list[Frame]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, office[3].rgb.shape).astype(np.uint8)
    spoilt = [dataclasses.replace(f, rgb=noise) if f.index == 3 else f for f in office]
    slam = run(PHOTOMETRIC, spoilt)
    verdicts = [r.verdict for r in slam.reports]
    assert verdicts[3] is Verdict.LOST and slam.reports[3].reason
    assert 3 not in slam.keyframe_indices
    assert verdicts[4] is not Verdict.LOST and errors_cm(slam, office)[4] < 2.0


def test_a_second_run_is_the_same_to_the_bit(office: list[Frame]) -> None:
    first, second = run(PHOTOMETRIC, office[:4]), run(PHOTOMETRIC, office[:4])
    for a, b in zip(first.reports, second.reports, strict=True):
        assert (a.T_wc == b.T_wc).all()


def test_a_lost_frame_is_found_by_colour(device: str, office: list[Frame]) -> None:
    """Depth of so few readings that nothing is registered; colour is compared where they are."""
    holes = np.zeros(office[3].depth.shape, bool)
    holes[:] = True
    holes[::2, 10:60] = False
    sparse = dataclasses.replace(office[3], depth=np.where(holes, 0.0, office[3].depth).astype(np.float32))
    spoilt = [sparse if f.index == 3 else f for f in office]
    slam = run(HYBRID, spoilt, device)
    assert slam.reports[3].verdict is not Verdict.CONVERGED or max(errors_cm(slam, office)) < 0.5
    assert errors_cm(slam, office)[4] < 0.5 and slam.reports[4].verdict is Verdict.CONVERGED


def test_another_picture_does_not_move_the_camera(office: list[Frame], rng: np.random.Generator) -> None:
    noise = rng.integers(0, 256, office[3].rgb.shape).astype(np.uint8)
    noisy = [
        dataclasses.replace(
            f,
            depth=f.depth * (1 + 0.005 * rng.normal(size=f.depth.shape)).astype(np.float32),
            rgb=noise if f.index == 3 else f.rgb,
        )
        for f in office
    ]
    slam = run(HYBRID, noisy)
    assert max(errors_cm(slam, noisy)) < 2.0


def test_descent_through_the_renderer_finds_the_pose_too(device: str, office: list[Frame]) -> None:
    refinement = RefinementConfig(method="descent")
    config = dataclasses.replace(PHOTOMETRIC, refinement=refinement)
    slam = run(config, office[:4], device)
    assert max(errors_cm(slam, office[:4])) < 2.0
    # As published: tens of renders a frame, at most a hundred.
    assert all(r.verdict is Verdict.CONVERGED for r in slam.reports)


def test_flat_and_black_parts_of_a_picture_are_not_compared() -> None:
    rgb = np.full((64, 64, 3), 90, np.uint8)
    rgb[20:30, 10:50] = 200
    rgb[40:, :] = 0
    mask = edge_mask(rgb, 1.1)
    assert mask[20, 20] == 1 and mask[5, 5] == 0 and not mask[42:].any()
