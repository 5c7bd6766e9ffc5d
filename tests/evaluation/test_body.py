# SPDX-License-Identifier: Apache-2.0
"""Where a camera sits on a body is found from the poses of both."""

import numpy as np
import pytest

from ggwarp.evaluation.body import camera_in_body
from ggwarp.geometry import se3


def path(rng: np.random.Generator, frames: int = 40) -> np.ndarray:
    poses = [np.eye(4)]
    for _ in range(frames - 1):
        poses.append(poses[-1] @ se3.se3_exp(np.r_[rng.normal(0, 0.05, 3), rng.normal(0, 0.1, 3)]))
    return np.stack(poses)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_any_mounting_is_found(rng: np.random.Generator, noise: float) -> None:
    body = path(rng)
    want = se3.se3_exp([0.3, -0.1, 0.2, 1.5, -2.0, 0.4])
    shaken = np.stack([se3.se3_exp(rng.normal(0, noise, 6)) for _ in body])
    camera = se3.se3_exp([4, 5, 6, 0.3, 0.2, 0.1]) @ body @ want @ shaken
    got = camera_in_body(camera, body)
    assert np.linalg.norm(se3.se3_log(se3.inverse(want) @ got)) < 1e-9 + 5.0 * noise


def test_a_camera_that_turns_about_one_axis_is_still_placed(rng: np.random.Generator) -> None:
    """What is not told is chosen somehow, and explains the poses as well."""
    body = np.stack([se3.se3_exp([0.02 * i, 0.01 * i * i, 0, 0, 0.05 * i, 0]) for i in range(30)])
    camera = body @ se3.se3_exp([0, 0, 0, 0.5, 0.6, 0.7])
    moved = body @ camera_in_body(camera, body)
    between = np.linalg.inv(moved[:-1]) @ moved[1:]
    np.testing.assert_allclose(between, np.linalg.inv(camera[:-1]) @ camera[1:], atol=1e-6)
