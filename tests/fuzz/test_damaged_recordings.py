# SPDX-License-Identifier: Apache-2.0
"""Damaged recordings of every layout: each is opened or refused in one line, each frame read or refused.

``GGWARP_DAMAGED=1000 python -m pytest tests/fuzz`` tries a thousand; otherwise it is a hundred.
"""

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from damage import damage
from every_layout import FRAMES, KINDS, place
from ggwarp.datasets import DatasetError, FrameError
from ggwarp.datasets.plan.sequence_plan import plan_sequence
from phone_recordings import opened

COUNT = int(os.environ.get("GGWARP_DAMAGED", "100"))
LONGEST_S = 60


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an undamaged recording of each kind."""
    root = tmp_path_factory.mktemp("whole")
    for name, write in KINDS.items():
        (root / name).mkdir()
        write(root / name)
    return root


class HangsError(BaseException):
    """Passes by all that catches exceptions."""


@pytest.fixture(autouse=True)
def no_hanging() -> Iterator[None]:
    """End a test that waits for ever, as for a pipe."""

    def ring(number: int, frame: object) -> None:
        raise HangsError

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(LONGEST_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("name", KINDS)
def test_undamaged_recordings_are_read(whole: Path, name: str) -> None:
    dataset = opened(place(whole / name))
    assert len(dataset) == FRAMES
    assert all(dataset[i].depth is not None for i in range(FRAMES))


@pytest.mark.parametrize("seed", range(COUNT))
def test_a_damaged_recording_is_read_or_refused(whole: Path, tmp_path: Path, seed: int) -> None:
    name = list(KINDS)[seed % len(KINDS)]
    folder = tmp_path / name
    shutil.copytree(whole / name, folder)
    done = damage(folder, seed)
    try:
        dataset = opened(place(folder))
        plan_sequence(dataset)
    except DatasetError as error:
        told(error, done)
        return
    good = 0
    for i in range(len(dataset)):
        try:
            frame = dataset[i]
        except FrameError as error:
            told(error, done)
            continue
        good += 1
        shape = (dataset.camera.height, dataset.camera.width)
        assert frame.rgb.shape == (*shape, 3) and frame.rgb.dtype == np.uint8, done
        assert np.isfinite(frame.timestamp), done
        if frame.depth is not None:
            assert frame.depth.shape == shape and frame.depth.dtype == np.float32, done
            assert np.isfinite(frame.depth).all() and (frame.depth >= 0).all(), done
        if frame.T_wc is not None:
            assert np.isfinite(frame.T_wc).all(), done
    assert good, f"opened, but empty: {done}"


def told(error: DatasetError, done: list[str]) -> None:
    """Check that an error is one line that can be printed, and says something."""
    text = str(error)
    assert text.isprintable() and 10 < len(text) < 1500, (done, text)
