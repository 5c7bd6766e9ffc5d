# SPDX-License-Identifier: Apache-2.0
"""Truth by another convention than the estimate's is named, and nothing else is."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ggwarp.datasets import open_dataset
from ggwarp.evaluation.conventions import doubt_of_truth
from ggwarp.geometry import se3

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
ROS = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Takes points of a body whose x is forward and z up to the camera that looks along it."""


MARKER = se3.se3_exp([0.2, 0, -0.3, 0.7, 0, 0])


def walk(frames: int = 30) -> np.ndarray:
    """Camera-to-world poses of a hand-held walk: forwards, swaying and looking round."""
    poses = [np.eye(4)]
    rng = np.random.default_rng(1)
    for i in range(frames - 1):
        step = [0.01 * np.sin(0.5 * i), 0.003, 0.03, 0.01, 0.04 * np.cos(0.3 * i), 0.005]
        poses.append(poses[-1] @ se3.se3_exp(np.array(step) + rng.normal(0, 0.002, 6)))
    return se3.se3_exp([1, 2, 0.5, 0.3, -0.2, 1.0]) @ np.stack(poses)


def noisy(poses: np.ndarray, metres: float = 0.002, radians: float = 0.001) -> np.ndarray:
    """An estimate of ``poses`` in a world of its own."""
    rng = np.random.default_rng(2)
    noise = [se3.se3_exp([*rng.normal(0, metres, 3), *rng.normal(0, radians, 3)]) for _ in poses]
    return se3.se3_exp([5, 1, 2, 0.1, 2, 0.3]) @ poses @ np.stack(noise)


def w_first(poses: np.ndarray) -> np.ndarray:
    """Poses as they are read from w x y z in the place of x y z w."""
    out = poses.copy()
    for pose in out:
        w, x, y, z = se3.quat_from_matrix(pose[:3, :3])
        pose[:3, :3] = se3.matrix_from_quat([z, w, x, y])
    return out


def transposed(poses: np.ndarray) -> np.ndarray:
    out = poses.copy()
    out[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return out


def mirrored(poses: np.ndarray, axis: int) -> np.ndarray:
    mirror = np.eye(4)
    mirror[axis, axis] = -1.0
    return mirror @ poses @ mirror


def alone(poses: np.ndarray) -> np.ndarray:
    """Positions without rotations."""
    out = poses.copy()
    out[:, :3, :3] = np.eye(3)
    return out


def longer(poses: np.ndarray, scale: float) -> np.ndarray:
    out = poses.copy()
    out[:, :3, 3] *= scale
    return out


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda T: T @ OPENGL, "OpenGL's axes .*turn them by 180 degrees about x"),
        (np.linalg.inv, "if they are world-to-camera: invert them"),
        (lambda T: OPENGL @ np.linalg.inv(T), "if they are world-to-camera with OpenGL's axes"),
        (w_first, "if their quaternions are written w first"),
        (transposed, "if their rotations are transposed"),
        (lambda T: longer(T, 1000.0), "1e\\+03 times as long .*: are the true poses in millimetres, or is"),
        (lambda T: longer(T, 0.2), r"0\.2.* times as long .* else agrees: is the depth's"),
        (lambda T: np.concatenate([T[1:], T[-1:]]), "if they are 1 frame late"),
        (lambda T: np.concatenate([T[:1], T[:1], T[:-2]]), "if they are 2 frames early"),
        (lambda T: np.concatenate([T[9:], T[-9:]]), "if they are 9 frames late"),
        (lambda T: T[::-1], "if they are in reverse order"),
        (lambda T: mirrored(T, 1), r"if they are left-handed \(Unity's\): mirror y"),
        (lambda T: mirrored(T, 2), "if they are left-handed: mirror z"),
        (lambda T: T @ ROS, r"if they are of a body with ROS's axes \(x forward, z up\)"),
        (lambda T: T @ MARKER, r"turned by 40 degrees about \(-1 0 0\) and 3[56] cm away"),
        (alone, "the true rotations are all the same: are they positions alone"),
    ],
    ids=["opengl", "inverse", "inverse opengl", "w first", "transposed", "mm", "scale", "late", "early",
         "far too late", "reverse", "mirrored y", "mirrored z", "ros", "a marker", "positions"],
)  # fmt: skip
def test_another_convention_is_named(change: Callable, says: str) -> None:
    true = walk()
    estimated = noisy(true, 2e-4, 1e-4) if "frame" in says else noisy(true)
    assert re.search(says, doubt_of_truth(estimated, change(true)))


@pytest.mark.parametrize(
    "estimate",
    [
        noisy,
        lambda T: noisy(T, 0.0, 0.0),
        lambda T: noisy(T, 0.05, 0.05),
        lambda T: T @ np.stack([se3.se3_exp([0.001 * i, 0, 0, 0, 0.0005 * i, 0]) for i in range(len(T))]),
        lambda T: longer(noisy(T), 1.05),
    ],
    ids=["good", "exact", "poor", "drifting", "a little short"],
)
def test_an_estimate_that_is_only_poor_blames_nothing(estimate: Callable) -> None:
    assert doubt_of_truth(estimate(walk()), walk()) == ""


@pytest.mark.parametrize("frames", [5, 6, 20, 29])
def test_short_walks_are_judged_too(frames: int) -> None:
    """Of no more frames than the truth may be early or late by."""
    true = walk(frames)
    assert doubt_of_truth(noisy(true, 0.05, 0.05), true) == ""


def test_what_says_nothing() -> None:
    still = np.stack([np.eye(4)] * 9)
    assert doubt_of_truth(still, still) == "" == doubt_of_truth(walk()[:4], np.linalg.inv(walk()[:4]))
    assert doubt_of_truth(walk()[:9], still) == ""


@pytest.mark.parametrize(
    "name", ["redkitchen", "livingroom1", "fr1/xyz", "rgbd_dataset_freiburg3_teddy", "desk_loop"]
)
def test_real_truth_is_not_doubted_and_its_misreadings_are(recordings: Path, name: str) -> None:
    dataset = open_dataset(name, data_root=recordings, masks="none")
    entries = dataset._entries[:120]  # their poses alone, without decoding a picture
    true = np.stack([entry.T_wc for entry in entries if entry.T_wc is not None])
    estimated = noisy(true, 0.005, 0.002)
    assert doubt_of_truth(estimated, true) == ""
    assert "OpenGL" in doubt_of_truth(estimated, true @ OPENGL)
    assert "times as long" in doubt_of_truth(estimated, longer(true, 5.0))
