# SPDX-License-Identifier: Apache-2.0
"""TUM trajectories and the files they are kept in."""

from pathlib import Path

import numpy as np
import pytest

from ggwarp.geometry import se3
from ggwarp.io.atomic import atomic_write
from ggwarp.io.trajectory import read_tum, write_tum


def test_what_is_written_is_read_back(tmp_path: Path, rng: np.random.Generator) -> None:
    poses = [se3.se3_exp(rng.normal(size=6)) for _ in range(20)]
    stamps = 1305031102.175304 + np.arange(20) / 30
    write_tum(tmp_path / "trajectory.txt", stamps, poses)
    got_stamps, got = read_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(got_stamps, stamps, rtol=0, atol=1e-6)
    np.testing.assert_allclose(got, poses, rtol=0, atol=5e-9)


def test_a_row_is_time_position_quaternion_with_w_last(tmp_path: Path) -> None:
    quarter_turn_about_z = se3.se3_exp([0, 0, 0, 0, 0, np.pi / 2])
    quarter_turn_about_z[:3, 3] = 1, 2, 3
    write_tum(tmp_path / "t.txt", [5.0], [quarter_turn_about_z])
    row = (tmp_path / "t.txt").read_text().splitlines()[-1]
    np.testing.assert_allclose(
        [float(w) for w in row.split()], [5, 1, 2, 3, 0, 0, 0.5**0.5, 0.5**0.5], atol=1e-9
    )


def test_unknown_poses_are_left_out(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.txt", [0.0, 1.0, 2.0], [np.eye(4), None, np.eye(4)])
    assert list(read_tum(tmp_path / "t.txt")[0]) == [0.0, 2.0]


def test_an_empty_trajectory_is_one(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.txt", [], [])
    stamps, poses = read_tum(tmp_path / "t.txt")
    assert stamps.shape == (0,) and poses.shape == (0, 4, 4)


@pytest.mark.parametrize("row", ["1 2 3", "1 0 0 0 0 0 0 one", "1 0 0 0 0 0 0 nan", "1 0 0 0 0 0 0 0"])
def test_a_malformed_row_is_named(tmp_path: Path, row: str) -> None:
    (tmp_path / "t.txt").write_text(f"# header\n0 0 0 0 0 0 0 1\n{row}\n")
    with pytest.raises(ValueError, match=r"t\.txt:3: "):
        read_tum(tmp_path / "t.txt")


def test_lengths_must_agree(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        write_tum(tmp_path / "t.txt", [0.0], [])
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError), atomic_write(path) as file:
        file.write(b"half of the n")
        raise RuntimeError
    assert path.read_bytes() == b"old" and [p.name for p in tmp_path.iterdir()] == ["map.ply"]
