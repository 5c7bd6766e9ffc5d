# SPDX-License-Identifier: Apache-2.0
"""Direct alignment finds the pose from which a picture of a painted plane was taken."""

import numpy as np
import pytest
import warp as wp

from ggwarp.geometry import se3
from ggwarp.geometry.camera import Camera
from ggwarp.solvers.alignment import Aligner, Alignment, halved
from ggwarp.solvers.pose_equations import Prior

CAMERA = Camera(120, 91, 110.0, 110.0, 59.5, 45.0)


def seen_from(T_cw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour [h, w, 3] and depth [h, w] of a slanted plane with waves painted on it."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    T_wc = se3.inverse(T_cw)
    rays = rays @ T_wc[:3, :3].T
    n, d = np.array([0.2, -0.1, 1.0]), 2.0
    depth = (d - n @ T_wc[:3, 3]) / (rays @ n)
    x = T_wc[:3, 3] + depth[..., None] * rays
    a, b = x[..., 0], x[..., 1]
    waves = [np.sin(7 * a + 2 * b), np.sin(9 * b - 3 * a + 1), np.sin(5 * a) * np.cos(6 * b)]
    return 0.5 + 0.35 * np.stack(waves, -1), depth


def aligner(T_rw: np.ndarray, picture: np.ndarray, device: str, holes: np.ndarray | None = None) -> Aligner:
    """Return one that looks for ``picture`` in a render from ``T_rw``, transparent in ``holes`` [96, 128]."""
    colour, depth = seen_from(T_rw)
    shape = (96, 128)
    image = np.zeros((4, *shape), np.float32)
    image[:3, : CAMERA.height, : CAMERA.width] = colour.transpose(2, 0, 1)
    image[3, : CAMERA.height, : CAMERA.width] = depth
    made = Aligner(CAMERA, device=device)
    made.take_picture(np.clip(255.0 * picture + 0.5, 0, 255).astype(np.uint8))
    transmittance = np.zeros(shape, np.float32) if holes is None else holes.astype(np.float32)
    made.take_render(wp.array(image, device=device), wp.array(transmittance, device=device), T_rw)
    return made


TRUE = se3.se3_exp([0.06, -0.04, 0.05, 0.02, 0.03, -0.02])


def test_the_pose_is_found(device: str) -> None:
    found = aligner(np.eye(4), seen_from(TRUE)[0], device).align(np.eye(4))
    assert np.abs(se3.se3_log(found.T_cw @ se3.inverse(TRUE))).max() < 1e-3
    assert found.system.mean_cost < 0.05 and found.system.pixels > 0.6 * CAMERA.width * CAMERA.height


def test_brightness_is_found_beside_it(device: str) -> None:
    picture = np.exp(-0.2) * seen_from(TRUE)[0] + 0.05
    searched = aligner(np.eye(4), picture, device)
    found, blind = searched.align(np.eye(4)), searched.align(np.eye(4), fit_exposure=False)
    np.testing.assert_allclose(found.exposure, (-0.2, 0.05), atol=0.01)
    assert blind.exposure == (0.0, 0.0)

    def error(T_cw: np.ndarray) -> float:
        return float(np.abs(se3.se3_log(T_cw @ se3.inverse(TRUE))).max())

    assert error(found.T_cw) < 1.5e-3 and error(found.T_cw) < error(blind.T_cw)


def test_a_prior_holds_what_it_knows(device: str) -> None:
    searched = aligner(np.eye(4), seen_from(TRUE)[0], device)
    firm = searched.align(np.eye(4), prior=Prior(np.eye(4), 1e12 * np.eye(6)))
    assert np.abs(se3.se3_log(firm.T_cw)).max() < 1e-5
    loose = searched.align(np.eye(4), prior=Prior(np.eye(4), 1e-6 * np.eye(6)))
    assert np.abs(se3.se3_log(loose.T_cw @ se3.inverse(TRUE))).max() < 1e-3


@pytest.mark.parametrize("recorded", [False, True])
def test_a_recording_serves_any_references_priors_and_starts(device: str, recorded: bool) -> None:
    """One after another, each as by an aligner of its own that records nothing."""
    if recorded and wp.get_device(device).is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("no loops in graphs")
    poses = [se3.se3_exp(share * se3.se3_log(TRUE)) for share in (0.0, 0.3, 0.8)]
    taken = [(np.clip(255.0 * c + 0.5, 0, 255).astype(np.uint8), d) for c, d in map(seen_from, poses)]
    picture = np.clip(255.0 * seen_from(TRUE)[0] + 0.5, 0, 255).astype(np.uint8)
    prior = Prior(TRUE, 1e6 * np.eye(6))

    def searched(made: Aligner, chosen: list[int], start: int, prior: Prior | None, fit: bool) -> Alignment:
        made.take_picture(picture)
        references = [
            made.reference(rgb, d.astype(np.float32), se3.inverse(poses[r]))
            for r in chosen
            for rgb, d in [taken[r]]
        ]
        return made.align(poses[start], references=references, prior=prior, fit_exposure=fit)

    kept = Aligner(CAMERA, recorded=recorded, device=device)
    cases = [
        ([0], 0, None),
        ([1], 0, None),
        ([0, 1], 0, prior),
        ([1, 2], 1, None),
        ([2], 2, prior),
        ([0], 1, None),
    ]
    for fit in (True, False):
        for chosen, start, known in cases:
            found = searched(kept, chosen, start, known, fit)
            alone = searched(Aligner(CAMERA, recorded=False, device=device), chosen, start, known, fit)
            np.testing.assert_array_equal(found.T_cw, alone.T_cw)
            np.testing.assert_array_equal(found.information, alone.information)
            assert (found.exposures, found.iterations) == (alone.exposures, alone.iterations)
            assert found.converged and np.abs(se3.se3_log(found.T_cw @ se3.inverse(TRUE))).max() < 1e-3


def test_a_blank_picture_moves_nothing(device: str) -> None:
    found = aligner(np.eye(4), np.full((CAMERA.height, CAMERA.width, 3), 0.5), device).align(np.eye(4))
    assert np.isfinite(found.T_cw).all()
    assert np.abs(se3.se3_log(found.T_cw)).max() < 1e-6


def test_a_small_picture_of_hardly_anything_decides_nothing(device: str, rng: np.random.Generator) -> None:
    holes = np.zeros((96, 128), bool)
    holes[1::4, 1::4] = True  # one in each pixel of the smallest picture...
    holes[36:56, 40:64] = False  # ... but a few, where the picture shows something else
    picture = seen_from(TRUE)[0]
    picture[36:56, 40:64] = rng.random((20, 24, 3))
    found = aligner(np.eye(4), picture, device, holes).align(se3.se3_exp(0.6 * se3.se3_log(TRUE)))
    assert np.abs(se3.se3_log(found.T_cw @ se3.inverse(TRUE))).max() < 5e-3


@pytest.mark.parametrize("size", [(120, 91), (33, 16)])
def test_a_halved_camera_sees_the_means_of_four_pixels(size: tuple[int, int]) -> None:
    camera = Camera(*size, 50.0, 60.0, 20.3, 11.7)
    half = halved(camera)
    assert (half.width, half.height) == (size[0] // 2, size[1] // 2)
    # The ray of the four pixels' common corner is that of the coarse pixel's centre.
    assert (2 * 3 + 0.5 - camera.cx) / camera.fx == pytest.approx((3 - half.cx) / half.fx)
    assert (2 * 4 + 0.5 - camera.cy) / camera.fy == pytest.approx((4 - half.cy) / half.fy)
