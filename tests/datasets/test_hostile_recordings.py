# SPDX-License-Identifier: Apache-2.0
"""Whole recordings with damage anywhere: each frame comes, or says in one line why it does not."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggwarp.datasets import DatasetError, FrameError, open_dataset

Maker = Callable[..., Path]
ODD = [
    *(b"\0", b"\x1b[31m", b"\xff\xfe", b"nan", b"-inf", b"1" + b"0" * 400, b"9" * 5000),
    *(b"/dev/zero", b"../", b"[", b"#"),
]


def read_all(folder: Path) -> Iterator[str]:
    """Yield why the recording, or a frame of it, cannot be used."""
    try:
        dataset = open_dataset(str(folder), data_root=folder)
    except DatasetError as error:
        yield str(error)
        return
    for index in range(len(dataset)):
        try:
            frame = dataset[index]
        except FrameError as error:
            yield str(error)
        else:
            assert frame.rgb.shape == (dataset.camera.height, dataset.camera.width, 3)
            assert frame.depth is None or np.isfinite(frame.depth).all()
            assert frame.T_wc is None or (np.abs(frame.T_wc) < 1e6).all()


@pytest.fixture
def recordings_of_each_kind(
    make_replica: Maker, make_tum: Maker, make_folder: Maker, sample: SimpleNamespace
) -> list[Path]:
    replica, tum, folder = make_replica(2), make_tum([0.0, 1.0], [0.0, 1.0], [0.0, 1.0]), make_folder(2)
    (folder / "traj.txt").write_text("\n".join(sample.matrix_row(sample.pose(i)) for i in range(2)))
    for i in range(2):
        sample.save(folder / f"object_mask/{i}.png", sample.colour(i)[..., 0])
    return [replica, tum, folder]


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_anywhere_is_told_in_one_line(
    recordings_of_each_kind: list[Path], data: st.DataObject
) -> None:
    folder = data.draw(st.sampled_from(recordings_of_each_kind))
    files = sorted(path for path in folder.parent.rglob("*") if path.is_file() and path.stat().st_size)
    path = data.draw(st.sampled_from(files))
    whole = path.read_bytes()
    at = data.draw(st.integers(0, len(whole)))
    end = data.draw(st.sampled_from([at, at + 1, at + 8, len(whole)]))
    odd = data.draw(st.sampled_from(ODD) | st.binary(max_size=8))
    try:
        path.write_bytes(whole[:at] + odd + whole[end:])
        for reason in read_all(folder):
            assert "\n" not in reason and "Traceback" not in reason
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("kind", [0, 1, 2])
@pytest.mark.parametrize("make", ["pipe", "device", "folder", "gone"])
def test_files_that_are_none(recordings_of_each_kind: list[Path], kind: int, make: str) -> None:
    """Nothing waits, nothing fills the memory, no error of another kind appears."""
    folder = recordings_of_each_kind[kind]
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        whole = path.read_bytes()
        path.unlink()
        if make == "pipe":
            os.mkfifo(path)
        elif make == "device":
            path.symlink_to("/dev/zero")
        elif make == "folder":
            path.mkdir()
        list(read_all(folder))
        if make == "folder":
            path.rmdir()
        else:
            path.unlink(missing_ok=True)
        path.write_bytes(whole)
